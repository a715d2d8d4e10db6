"""What was set by hand in the page, as a change of the campaign file that is shown and written."""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from modetune.adapters.yaml_edit import edited
from modetune.adapters.yaml_file import Place, YamlFile, parse_yaml
from modetune.core.errors import CampaignError
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.flows.campaign.campaign import campaign_form


@dataclass(frozen=True, slots=True)
class Change:
    """A campaign file as it stands and its text after a change; notes: what else follows from it.

    before: what is to be written first, such as a file that the new text names.
    """

    source: YamlFile
    text: str
    notes: tuple[str, ...] = ()
    before: Callable[[], None] | None = None

    @property
    def base(self) -> str:
        """Names what the file holds now."""
        return hashlib.sha256(self.source.text.encode()).hexdigest()

    @property
    def after(self) -> YamlFile:
        """The file as it will be."""
        return parse_yaml(self.source.path, self.text, "a campaign")

    def noting(self, *notes: str) -> Change:
        """The change with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def told(self) -> dict[str, Json]:
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
            raise CampaignError(
                f"{self.source.path} was changed meanwhile; look at the change again"
            )
        if self.before is not None:
            self.before()
        mode = path.stat().st_mode & 0o777
        with writing(path, "write the change there by hand") as part:
            part.write_bytes(self.text.encode())
        path.chmod(mode)


def change_of(
    source: YamlFile,
    values: Mapping[Place, object],
    notes: tuple[str, ...] = (),
    before: Callable[[], None] | None = None,
) -> Change:
    """A change of values in a campaign file. Raises CampaignError where it would not be read."""
    change = Change(source, edited(source, values), notes, before)
    campaign_form(change.after)
    return change
