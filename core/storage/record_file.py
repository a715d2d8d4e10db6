"""Files of records: a dataclass in a sealed file of its own, by the codec.

A record of another format, older or newer, is not read: a sentence says so, and what to do. One
that its seal denies is never opened by HDF5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.modes import ModeSet, mode_set
from modetune.core.storage.codec import read_value, write_value
from modetune.core.storage.files import writing
from modetune.core.storage.record import CampaignRecord, IterationRecord
from modetune.core.storage.seal import LONGEST_TITLE, content, holds, sealed, title_of

R = TypeVar("R")
HDF5 = b"\x89HDF"


@dataclass(frozen=True, slots=True)
class RecordFile(Generic[R]):
    """A kind of record: what it is of, its usual file name, and the number of its format.

    The number grows whenever the layout of its dataclasses changes.
    """

    kind: type[R]
    noun: str
    file: str
    format: int

    @property
    def _title(self) -> str:
        return f"modetune {self.noun} record "

    def write(self, path: Path, record: R) -> None:
        """Write a record whole or not at all. Raises StorageUnavailable."""
        data = sealed(f"{self._title}{self.format}", lambda file: write_value(file, record))
        with writing(path) as part:
            part.write_bytes(data)

    def read(self, path: Path) -> R:
        """The record as it was written. Raises StoreDamaged where the file is not what it was,
        CampaignError where it is not such a record, or of another format.
        """
        what = f"a record of a {self.noun} (the {self.file} in a run folder)"
        if not path.is_file():
            raise CampaignError(f"{path} is not there; a record is the {self.file} in a run folder")
        try:
            data = path.read_bytes()
        except OSError as error:
            raise CampaignError(f"{path} cannot be read: {error.strerror}") from error
        title = title_of(data)
        if data.startswith(HDF5):
            raise CampaignError(
                f"{path} is not {what} of this version: it is HDF5 without a seal, as earlier "
                f"versions of modetune and other programs write it; run the {self.noun} again"
            )
        if not title.startswith(self._title):
            raise CampaignError(f"{path} is not {what}, or its beginning is damaged")
        if title != f"{self._title}{self.format}":
            raise CampaignError(
                f"{path} is a {title.removeprefix('modetune ')}, and this version of modetune "
                f"reads format {self.format}; use the version that wrote it, or run the "
                f"{self.noun} again"
            )
        if not holds(data, title):
            raise StoreDamaged(
                f"the checksum of {path} does not hold: the record was damaged or cut short; copy "
                f"it again, or run the {self.noun} again, for which the store has what was solved"
            )
        try:
            with content(data) as file:
                return read_value(file, self.kind)
        except StoreDamaged as problem:
            raise StoreDamaged(f"{path} is not {what}: {problem}") from problem


CAMPAIGN = RecordFile(CampaignRecord, "campaign", "campaign.h5", 7)


def write_record(path: Path, record: CampaignRecord) -> None:
    """Write the record whole or not at all. Raises StorageUnavailable.

    What is for pictures alone is rounded to single precision, which packs: the surface, and the
    shapes on it, of the first and of the best accepted iteration only.
    """
    accepted = [item.number for item in record.iterations if item.accepted]
    shown = {accepted[0], accepted[-1]} if accepted else set()
    surface = record.surface
    if surface is not None:
        surface = replace(surface, coordinates=_single(surface.coordinates))
    iterations = tuple(
        replace(item, field=_pictured(item) if item.number in shown else mode_set([]))
        for item in record.iterations
    )
    CAMPAIGN.write(path, replace(record, surface=surface, iterations=iterations))


def read_record(path: Path) -> CampaignRecord:
    """A campaign's record as it was written, from its file or its run folder.

    Raises CampaignError, StoreDamaged.
    """
    record = CAMPAIGN.read(path / CAMPAIGN.file if path.is_dir() else path)
    if not any(item.accepted for item in record.iterations):
        raise CampaignError(f"{path} is not a record of a campaign: no iteration was accepted")
    return record


def is_record(path: Path) -> bool:
    """Whether a file is, by its first bytes, a campaign's record, or HDF5 without a seal."""
    with path.open("rb") as file:
        head = file.read(LONGEST_TITLE)
    return head.startswith(HDF5) or title_of(head).startswith(CAMPAIGN._title)


def _pictured(item: IterationRecord) -> ModeSet:
    return replace(item.field, mode_shapes=_single(item.field.mode_shapes))


def _single(values: Any) -> Any:
    single = np.complex64 if np.iscomplexobj(values) else np.float32
    return values.astype(single).astype(values.dtype)
