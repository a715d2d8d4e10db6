"""Decks with every edge cut in half: the same structure in elements of half the size."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks.halved import halved_deck

from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.model import understand
from modetune.core.errors import ModelError
from modetune.core.mesh import cell_sizes

#: Two bricks side by side have these grids: x, y, z.
BRICKS = [(float(x), float(y), float(z)) for z in (0, 1) for y in (0, 2) for x in (0, 3, 5)]


def deck(elements: str, grids: list[tuple[float, float, float]] = BRICKS) -> str:
    lines = ["SOL 103", "CEND", "SPC = 1", "METHOD = 1", "BEGIN BULK", "EIGRL,1,,,4"]
    lines += [f"GRID,{n},,{x},{y},{z}" for n, (x, y, z) in enumerate(grids, start=1)]
    return "\n".join([*lines, elements, "MAT1,1,7.+4,,.3,2.7-9", "ENDDATA", ""])


def halved(tmp_path: Path, text: str) -> tuple[Path, Path]:
    """The deck and its halves."""
    (tmp_path / "whole.bdf").write_text(text)
    halved_deck(tmp_path / "whole.bdf", tmp_path / "half.bdf")
    return tmp_path / "whole.bdf", tmp_path / "half.bdf"


#: Elements, and how many grids and elements there are after.
CASES = {
    "bricks": ("CHEXA,1,1,1,2,5,4,7,8\n,11,10\nCHEXA,2,1,2,3,6,5,8,9\n,12,11\nPSOLID,1,1", 45, 16),
    "wedges": ("CPENTA,1,1,1,2,5,7,8,11\nCPENTA,2,1,1,5,4,7,11,10\nPSOLID,1,1", 27, 16),
    "tetrahedra": ("CTETRA,1,1,1,2,4,7\nCTETRA,2,1,2,5,4,7\nPSOLID,1,1", 14, 16),
    "quadrilaterals": ("CQUAD4,1,1,1,2,5,4\nCQUAD4,2,1,2,3,6,5\nPSHELL,1,1,.1,1", 15, 8),
    "triangles": ("CTRIA3,1,1,1,2,5\nCTRIA3,2,1,1,5,4\nPSHELL,1,1,.1,1", 9, 8),
    "bars": ("CBAR,1,1,1,2,0.,0.,1.\nCBAR,2,1,2,3,0.,0.,1.\nPBAR,1,1,1.,1.,1.,1.", 5, 4),
}


@pytest.mark.parametrize("name", CASES)
def test_halves_fill_the_same_space_and_share_their_grids(tmp_path: Path, name: str) -> None:
    elements, n_grids, n_elements = CASES[name]
    whole, half = halved(tmp_path, deck(elements))
    before, after = (understand(read_deck(path)).mesh() for path in (whole, half))
    assert sum(cell_sizes(after).values()) > 0.0
    used = {int(n) for cells in after.cells for n in cells.nodes.ravel()}
    assert (len(used), sum(len(cells.nodes) for cells in after.cells)) == (n_grids, n_elements)
    volumes = [understand(read_deck(path)).structure.bulk for path in (whole, half)]
    mass = [sum(e.Mass() for e in bulk.elements.values()) for bulk in volumes]
    assert mass[1] == pytest.approx(mass[0], rel=1e-12)
    # A twisted half would have its corners in another order, and a smaller or negative volume.
    own = [e.Mass() for e in volumes[1].elements.values()]
    assert min(own) > 0.05 * mass[0] / n_elements
    assert before.nodes.size < after.nodes.size


def test_an_edge_whose_ends_are_held_is_held(tmp_path: Path) -> None:
    shells = "CQUAD4,1,1,1,2,5,4\nPSHELL,1,1,.1,1\nSPC1,1,123,1,2\nSPC1,1,3,4,5"
    _, half = halved(tmp_path, deck(shells))
    model = understand(read_deck(half))
    places = dict(zip(model.mesh().nodes.tolist(), model.mesh().coordinates.tolist(), strict=True))
    fixed = {tuple(places[n]): set(axes) for n, axes in model.fixed().items()}
    assert fixed[1.5, 0.0, 0.0] >= {1, 2, 3}
    assert fixed[0.0, 1.0, 0.0] & {1, 2, 3} == {3}  # what both ends share
    assert fixed[1.5, 2.0, 0.0] & {1, 2, 3} == {3}


def test_pins_and_offsets_of_a_beam_stay_at_its_ends(tmp_path: Path) -> None:
    bar = "CBAR,1,1,1,2,0.,0.,1.\n,5,46,0.,0.,1.,0.,0.,3.\nPBAR,1,1,1.,1.,1.,1."
    _, half = halved(tmp_path, deck(bar))
    first, last = sorted(
        understand(read_deck(half)).structure.bulk.elements.values(), key=lambda e: e.eid
    )
    assert (first.pa, first.pb, last.pa, last.pb) == (5, 0, 0, 46)
    assert first.wa.tolist() == [0.0, 0.0, 1.0]
    assert first.wb.tolist() == last.wa.tolist() == [0.0, 0.0, 2.0]
    assert last.wb.tolist() == [0.0, 0.0, 3.0]


def test_a_deck_without_halves_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="CSHEAR 1 is not cut in half"):
        halved(tmp_path, deck("CSHEAR,1,1,1,2,5,4\nPSHEAR,1,1,.1"))
    with pytest.raises(ModelError, match="no element"):
        halved(tmp_path, deck("CROD,1,1,1,2\nPROD,1,1,1."))
