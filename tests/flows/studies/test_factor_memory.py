"""What `check` tells of the memory of factors: a row of bricks, a shell strip, a MYSTRAN frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import modetune
from modetune.core.algebra import eigen, factor_room, pardiso
from modetune.flows.diagnosis.findings import Finding
from modetune.flows.studies.check import model
from tests.adapters.mystran_decks import frame
from tests.adapters.solved import needs_ccx, needs_mystran
from tests.flows.studies.test_condensation import STRIP, measured_of
from tests.flows.updating.test_stored_matrices import row_of_materials

pytestmark = pytest.mark.skipif(
    not pardiso.is_available(), reason="PARDISO is installed on x86_64 only"
)
CAMPAIGN = """name: part
model: {deck: %s, solver: %s, units: m-kg-s, eigensolver: pardiso}
test: {modes: %s}
parameters: [{name: E, quantity: %s, bounds: [0.5, 2.0]}]
"""
DECKS: dict[str, Any] = {
    "row.inp": (row_of_materials(12), [6, 18, 30, 42], "youngs_modulus, material: A1"),
    "strip.inp": (STRIP, [31, 52, 62, 81, 92, 112, 121], "youngs_modulus, material: M"),
    "frame.bdf": (frame(), [1, 3, 5, 8, 10, 12, 15, 17], "youngs_modulus, material: 1"),
}


@pytest.fixture(params=[
    pytest.param("row.inp", marks=needs_ccx),
    pytest.param("strip.inp", marks=needs_ccx),
    pytest.param("frame.bdf", marks=needs_mystran),
])  # fmt: skip
def part(request: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A campaign's file; modes by factors, however few unknowns there are."""
    monkeypatch.chdir(tmp_path)
    for module in (eigen, model):
        monkeypatch.setattr(module, "DENSE", 40)
    text, nodes, target = DECKS[request.param]
    Path(request.param).write_text(text)
    test, _ = measured_of(request.param, nodes, "xyz")
    solver = "mystran" if request.param == "frame.bdf" else "calculix"
    Path("part.yaml").write_text(CAMPAIGN % (request.param, solver, test, target))
    return "part.yaml"


def told(file: str, limit_gb: float | None = None) -> Finding:
    settings = [] if limit_gb is None else [f"run.memory_gb={limit_gb:.9f}"]
    (found,) = [
        item
        for item in modetune.check(file, settings=settings).findings
        if item.where == "run.memory_gb" or "run.memory_gb" in item.what
    ]
    return found


def test_check_tells_where_the_factors_go_and_at_what_price(
    part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(factor_room, "_resident", lambda: 0)
    roomy = told(part)
    assert roomy.level == "good"
    assert roomy.what.endswith("they stay in memory")
    in_memory = float(roomy.what.split(" equations take ")[1].split()[0])
    beside = float(roomy.what.split(" in addition to ")[1].split()[0])
    tight = told(part, 0.99 * (in_memory + beside))
    on_disk = tight.level == "doubtful"
    if on_disk:  # of small models, what is kept in any case leaves next to nothing to spare
        assert "written once a factorisation" in tight.what
        assert tight.remedy
    else:
        assert "with factors on disk too" in tight.what
    assert told(part, 1e-6).level == "wrong"
    monkeypatch.setattr(model, "is_available", lambda: False)
    assert "PARDISO is not installed" in told(part, 0.5).what
    assert not [item for item in modetune.check(part).findings if "factors" in item.what]
