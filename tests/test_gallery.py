"""Pages and notebooks that show real runs: what they show is what is printed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.command_line import run_command
from tests.test_docs import DOCS, tool

printed = tool("printed")


def test_a_line_that_is_not_printed_is_told(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```\n$ modetune --version\nmodetune 999\n...\n```\n")
    (found,) = printed.differences(printed.blocks(page))
    assert found.shown == "modetune 999"
    assert found.printed.startswith("modetune ")


@pytest.mark.parametrize(
    ("shown", "other", "same"),
    [
        ("error -0.39 %", "error -0.40 %", True),
        ("error -0.39 %", "error -0.45 %", False),
        ("E_wing 58594.4", "E_wing   58601.2", True),
        ("trusted", "not to be trusted", False),
        ("p 2e-123", "p 2e-3", False),
        ("solver runs: 1 modal, ...", "solver runs: 1 modal, 2 sensitivity; 63 s", True),
        ("solver runs: 1 modal, ...", "solver runs: 4 modal, 2 sensitivity; 63 s", False),
    ],
)
def test_numbers_are_compared_as_they_are_printed(shown: str, other: str, same: bool) -> None:
    assert printed.alike(shown, other) is same


#: Begins the block of the aircraft of 20,580 solid elements.
FINE = "$ modetune demo garteur\n"


@pytest.mark.filterwarnings("default")  # as a user's commands run
@pytest.mark.timeout(900)  # a page's commands, one after the other, on a machine that is busy
@pytest.mark.parametrize("page", ["../README.md", "gallery.md", "bracket.md"])
def test_a_page_shows_what_is_printed(page: str) -> None:
    short = [block for block in printed.blocks(DOCS / page) if not block.startswith(FINE)]
    found = list(printed.differences(short, run_command))
    assert not found, "\n".join(map(str, found))


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_the_gallery_shows_what_the_fine_aircraft_prints() -> None:
    (long,) = (block for block in printed.blocks(DOCS / "gallery.md") if block.startswith(FINE))
    found = list(printed.differences([long]))
    assert not found, "\n".join(map(str, found))


@pytest.mark.parametrize("path", sorted((DOCS / "notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
@pytest.mark.filterwarnings("default")  # of the notebook's packages
def test_a_notebook_shows_what_is_printed(path: Path, tmp_path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    shown, run = (nbformat.reads(path.read_text(), 4) for _ in range(2))  # type: ignore[no-untyped-call]
    where = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(run, timeout=250, kernel_name="python3", resources=where).execute()
    texts = [line for cell in run.cells for line in _printed(cell)]
    told = [line for cell in shown.cells for line in _printed(cell)]
    assert len(told) > 10
    wrong = [(a, b) for a, b in zip(told, texts, strict=True) if not printed.alike(a, b)]
    assert not wrong


def _printed(cell: Any) -> list[str]:
    """The lines under a cell, without what goes to standard error."""
    return [
        line
        for item in cell.get("outputs", [])
        if item.get("name") != "stderr"
        for line in (item.get("text") or item["data"]["text/plain"]).splitlines()
    ]
