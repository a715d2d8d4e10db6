"""CONTRIBUTING.md is true: every path, every name in a file, and every example of an addition."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.test_structure import ROOT

PAGES = (ROOT / "CONTRIBUTING.md", ROOT / "docs" / "style.md")
#: A path of the repository in code type, with the name of something in it where one follows.
REFERENCE = re.compile(r"`((?:[\w.-]+/)+[\w.-]*)(?:: (\w+))?`")


def references(page: Path) -> list[tuple[str, str]]:
    """Paths and the names in them that a page gives; a name is empty where none follows."""
    found = REFERENCE.finditer(page.read_text("utf-8"))
    return [(match[1], match[2] or "") for match in found]


def rows() -> list[list[str]]:
    """The cells of each row of CONTRIBUTING's table of additions."""
    text = PAGES[0].read_text("utf-8").partition("| to add |")[2].partition("\n\n")[0]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[2:]]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_and_name_is_there(page: Path) -> None:
    found = references(page)
    assert found
    for path, name in found:
        if path.startswith(".venv"):
            continue
        assert (ROOT / path).exists(), path
        if name:
            pattern = rf"^(?:def|class) {name}\b|^{name}\b.* = "
            assert re.search(pattern, (ROOT / path).read_text("utf-8"), re.M), f"{path}: {name}"


def test_each_addition_has_an_example_that_runs() -> None:
    assert len(rows()) >= 10
    for kind, *_, example in rows():
        (path,) = re.findall(r"`([\w./]+)`", example)
        if path.endswith(".yaml"):  # a campaign that a test runs
            name = Path(path).name
            tests = (ROOT / "tests").rglob("test_*.py")
            assert any(name in test.read_text("utf-8") for test in tests), f"{kind}: {path}"
        else:
            files = [ROOT / path] if path.endswith(".py") else (ROOT / path).glob("test_*.py")
            assert any("\ndef test_" in file.read_text("utf-8") for file in files), (
                f"{kind}: {path}"
            )
