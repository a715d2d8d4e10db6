"""The findings of a check as CI services show them: a Markdown summary and JUnit's XML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement

from modetune.core.errors import CampaignError
from modetune.flows.report.tables import Table


@dataclass(frozen=True, slots=True)
class CheckItem:
    """One test case of a check; failure is the reason, empty if it passed."""

    name: str
    failure: str = ""


@dataclass(frozen=True, slots=True)
class CheckOutcome:
    """The outcome of a check: name, conclusion in a sentence, tables, remarks and test cases."""

    name: str
    end: str
    tables: tuple[Table, ...]
    remarks: tuple[str, ...]
    items: tuple[CheckItem, ...]

    def write(self, summary: Path | None, junit: Path | None) -> None:
        """Append to a Markdown file (such as $GITHUB_STEP_SUMMARY) and write JUnit's XML.

        Raises CampaignError if a file cannot be written.
        """
        try:
            if summary is not None:
                with summary.open("a", encoding="utf-8") as file:
                    file.write(self.markdown())
            if junit is not None:
                _junit(self.name, self.items).write(junit, encoding="utf-8", xml_declaration=True)
        except OSError as error:
            raise CampaignError(f"{error.filename}: {error.strerror}") from None

    def markdown(self) -> str:
        parts = [f"### {_plain(self.name)}: {_plain(self.end)}"]
        parts += [f"**{_plain(table.title)}**\n\n{_table(table)}" for table in self.tables]
        if self.remarks:
            parts.append("\n".join(f"- {_plain(remark)}" for remark in self.remarks))
        return "\n\n".join(parts) + "\n\n"


def _table(table: Table) -> str:
    heads = " | ".join(_plain(column.head) for column in table.columns)
    sides = " | ".join(":--" if column.words else "--:" for column in table.columns)
    rows = [f"| {heads} |", f"| {sides} |"]
    for place, texts in enumerate(table.texts):
        cells = [
            f"**{_plain(text)}**" if text and table.is_outside(place, column) else _plain(text)
            for column, text in zip(table.columns, texts, strict=True)
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def _plain(text: str) -> str:
    """Escape what Markdown would format."""
    text = " ".join(text.split())
    return "".join(f"\\{letter}" if letter in r"\`*_[]<>|" else letter for letter in text)


def _junit(name: str, items: Sequence[CheckItem]) -> ElementTree[Element]:
    failed = sum(bool(item.failure) for item in items)
    suites = Element("testsuites")
    counts = {"tests": str(len(items)), "failures": str(failed), "errors": "0"}
    suite = SubElement(suites, "testsuite", {"name": f"modetune check {name}", **counts})
    for item in items:
        case = SubElement(suite, "testcase", {"classname": name, "name": item.name})
        if item.failure:
            SubElement(case, "failure", {"message": item.failure}).text = item.failure
    return ElementTree(suites)
