"""Changes of a campaign file that a user makes on the page: review, then write."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from modetune.adapters.yaml_file import Place, YamlFile, edited, parse_yaml
from modetune.core.errors import CampaignError
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.flows.campaign.campaign import campaign_form
from modetune.flows.campaign.configurations import BASE, configuration_files
from modetune.flows.campaign.schema import CampaignFile

#: A node, or a point in the axes and unit of length of the model.
Mark = int | tuple[float, float, float]
#: Lowest and highest frequency of a diagram, Hz; None for that of the functions.
Band = tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class Part:
    """A campaign file, or one of its configurations.

    file: the configuration as a campaign. place: position of its `model` and `test` in the source.
    """

    source: YamlFile
    file: CampaignFile
    place: Place = ()
    name: str = ""

    def at(self, *place: str | int) -> object:
        """A value of its `model` or `test`."""
        return self.source.at((*self.place, *place))

    def change(
        self,
        values: Mapping[Place, object],
        notes: tuple[str, ...] = (),
        before: Callable[[], None] | None = None,
    ) -> Change:
        """A change of its values. Raises CampaignError where the file would not be read."""
        placed = {(*self.place, *place): value for place, value in values.items()}
        change = Change(self.source, edited(self.source, placed), notes, before)
        campaign_form(change.after)
        return change


def part_of(source: YamlFile, configuration: str = "") -> Part:
    """The configuration of a name, else the first; the file where it has none.

    Raises CampaignError, ModelError.
    """
    file = campaign_form(source)
    if not file.configurations:
        return Part(source, file)
    parts = configuration_files(source, file, [])
    found = next((part for part in parts if part.section.name == configuration), parts[0])
    return Part(found.source, found.file, found.place, found.section.name)


def configuration_names(source: YamlFile) -> list[Json]:
    """Return the configurations to choose from; none for one model. Raises CampaignError."""
    file = campaign_form(source)
    base = [BASE] if file.configurations and file.model is not None else []
    return [*base, *(item.name for item in file.configurations)]


@dataclass(frozen=True, slots=True)
class Change:
    """A campaign file and its text after a change; notes: other consequences.

    before: a function to call first, such as one that writes a file named in the new text.
    """

    source: YamlFile
    text: str
    notes: tuple[str, ...] = ()
    before: Callable[[], None] | None = None

    @property
    def base(self) -> str:
        """SHA-256 of the current text."""
        return hashlib.sha256(self.source.text.encode()).hexdigest()

    @property
    def after(self) -> YamlFile:
        """The file as it will be."""
        return parse_yaml(self.source.path, self.text, "a campaign")

    def noting(self, *notes: str) -> Change:
        """The change with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def to_json(self) -> dict[str, Json]:
        name = self.source.path.name
        old, new = self.source.text.splitlines(), self.text.splitlines()
        lines = difflib.unified_diff(old, new, name, name, lineterm="", n=2)
        return {"base": self.base, "diff": list(lines), "notes": list(self.notes), "file": name}

    def write(self, base: str) -> None:
        """Write the file whole or not at all, with the permissions it has.

        base: of the change that was shown. Raises CampaignError where the file is another since;
        StorageUnavailable.
        """
        path = self.source.path.resolve()  # a link stays one
        if base != self.base:
            raise CampaignError(f"{self.source.path} has changed since; review the change again")
        if self.before is not None:
            self.before()
        mode = path.stat().st_mode & 0o777
        with writing(path, "write the change there by hand") as part:
            part.write_bytes(self.text.encode())
        path.chmod(mode)
