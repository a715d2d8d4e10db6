"""Fields on structures of four kinds: one weak element or patch is found, and twins are told.

The truth of each is a deck with a material of its own for what is weak, solved by the solver
itself; the campaign's deck knows one material.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.errors import CampaignError
from modetune.core.modes import ModeSet, mode_set
from modetune.core.storage.campaign_record import CampaignRecord, read_record
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.report.campaign_charts import campaign_charts
from modetune.flows.report.field_tables import SHOWN, brief_record, fields_json
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.report.page import page
from modetune.flows.studies.paraview import write_field_file
from modetune.flows.studies.run_source import RunSource
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.update import update_campaign
from tests.adapters.ccx_decks import plate
from tests.adapters.test_solver_contract import run

needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not here")
needs_mystran = pytest.mark.skipif(not shutil.which("mystran"), reason="MYSTRAN is not installed")

CAMPAIGN = """name: twin
model: {deck: DECK, solver: SOLVER, units: mm-t-s, eigensolver: pardiso}
test: {modes: measured.csv}
parameters:
  - {name: E, quantity: youngs_modulus, material: A, bounds: [0.2, 1.5], field: {FIELD}}
residuals: {shape_weight: SHAPES, shape_deviation: 0.02}
update: {confirm: matrices}
report: {page: false}
"""
STEEL = "*ELASTIC\n{young}, 0.3\n*DENSITY\n2.7e-9\n"


def measured(
    folder: Path, solver: Solver, n_modes: int, nodes: Sequence[int], components: Sequence[int]
) -> ModeSet:
    """Modes of the truth at sensors, into the test's file."""
    (folder / "truth").mkdir()
    result = run(solver, {}, ModalAnalysis(n_modes, tuple(nodes)), folder / "truth")
    assert isinstance(result, ModalResult)
    modes = result.elastic
    kept = np.isin(modes.components, components) & np.isin(modes.nodes, nodes)
    found = mode_set(
        modes.frequencies_hz, modes.mode_shapes[kept], modes.nodes[kept], modes.components[kept]
    )
    write_modes_csv(folder / "measured.csv", range(1, modes.n_modes + 1), found)
    return found


def written(folder: Path, deck: str, solver: str, field: str, shapes: float) -> Path:
    text = CAMPAIGN.replace("DECK", deck).replace("SOLVER", solver)
    path = folder / "campaign.yaml"
    path.write_text(text.replace("FIELD", field).replace("SHAPES", str(shapes)))
    return path


def updated(path: Path, *settings: str) -> tuple[Campaign, CampaignRecord]:
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    campaign = load_campaign(path, list(settings))
    return campaign, update_campaign(campaign, path.parent / "run", silent).record


def beam(n: int, held: Sequence[int], weak: Sequence[int] = (), factor: float = 1.0) -> str:
    """n bricks of 10 x 10 x 8 in a row; held: cross-sections whose nodes rest."""
    nodes = [
        (4 * i + k + 1, 10.0 * i, y, z)
        for i in range(n + 1)
        for k, (y, z) in enumerate(((0.0, 0.0), (10.0, 0.0), (10.0, 8.0), (0.0, 8.0)))
    ]
    bricks = [(i + 1, *range(4 * i + 1, 4 * i + 9)) for i in range(n)]
    rows = "".join(", ".join(map(str, row)) + "\n" for row in nodes)
    text = f"*NODE, NSET=NALL\n{rows}"
    for name, own in (("B", [b for b in bricks if b[0] not in weak]),
                      ("W", [b for b in bricks if b[0] in weak])):  # fmt: skip
        if own:
            lines = "".join(", ".join(map(str, row)) + "\n" for row in own)
            text += f"*ELEMENT, TYPE=C3D8I, ELSET={name}\n{lines}"
    text += f"*MATERIAL, NAME=A\n{STEEL.format(young=70000.0)}*SOLID SECTION, ELSET=B, MATERIAL=A\n"
    if weak:
        text += f"*MATERIAL, NAME=AW\n{STEEL.format(young=70000.0 * factor)}"
        text += "*SOLID SECTION, ELSET=W, MATERIAL=AW\n"
    fixed = "".join(f"{4 * section + k},1,3\n" for section in held for k in range(1, 5))
    return f"{text}*BOUNDARY\n{fixed}*STEP\n*FREQUENCY\n6\n*END STEP\n"


@needs_ccx
def test_the_weak_brick_of_a_cantilever_is_found_by_two_matrix_jobs(tmp_path: Path) -> None:
    n, weak = 10, 4
    (tmp_path / "beam.inp").write_text(beam(n, [0]))
    (tmp_path / "true.inp").write_text(beam(n, [0], [weak], 0.6))
    truth = calculix_solver(tmp_path / "true.inp", ())
    measured(tmp_path, truth, 5, [10, 17, 27, 34, 41], [2, 3])
    path = written(tmp_path, "beam.inp", "calculix", "smoothing: sparse", 1.0)
    campaign, record = updated(path)
    # Bricks that share no node go together: two colours, one of which is what the other leaves.
    assert (record.runs.modal, record.runs.sensitivity) == (0, 2)
    (found,) = record.fields
    assert [record.parameters.names[found.field.columns[place[0]]] for place in found.places] == [
        f"E.{weak}"
    ]
    # A test without noise; the text of ccx's frequencies has 7 digits, what is left is the pull.
    assert record.updated[weak - 1] == pytest.approx(0.6, abs=0.02)
    assert np.abs(np.delete(record.updated, weak - 1) - 1.0).max() < 0.05
    assert found.changes[weak - 1] == pytest.approx(-0.4, abs=0.02)
    # What is kept: the record, tables of few rows, a chart of all, a file for ParaView.
    again = read_record(tmp_path / "run" / "campaign.h5")
    np.testing.assert_array_equal(again.fields[0].alone, found.alone)
    assert again.fields[0].places[0].tolist() == found.places[0].tolist()
    assert len(brief_record(record).parameters) == SHOWN
    charts = dict(campaign_charts(record))
    assert {"field_0", "l_curve"} <= charts.keys()
    assert "The field E" in page(record)
    (told,) = fields_json(record)
    zones = json.loads(json.dumps(told))["zones"]
    assert zones[weak - 1]["elements"] == [weak]
    out = write_field_file(RunSource(campaign, record, tmp_path), tmp_path / "paraview")
    assert out is not None
    pyvista = pytest.importorskip("pyvista")
    grid = pyvista.read(out)
    values = dict(
        zip(grid.cell_data["element"].tolist(), grid.cell_data["E"].tolist(), strict=True)
    )
    assert values[weak] == pytest.approx(record.updated[weak - 1])
    assert {"E_standard_error", "E_seen"} <= set(grid.cell_data)


@needs_ccx
def test_twins_of_a_symmetric_bar_are_two_answers_where_frequencies_alone_are_known(
    tmp_path: Path,
) -> None:
    n, weak = 8, 3
    (tmp_path / "beam.inp").write_text(beam(n, [0, n]))
    (tmp_path / "true.inp").write_text(beam(n, [0, n], [weak], 0.7))
    truth = calculix_solver(tmp_path / "true.inp", ())
    measured(tmp_path, truth, 5, [13], [2, 3])
    path = written(tmp_path, "beam.inp", "calculix", "zones: elements", 0.0)
    _, record = updated(path, "residuals.frequency_deviation=0.001")
    (found,) = record.fields
    places = {int(zone) for place in found.places for zone in place}
    assert {weak - 1, n - weak} <= places
    assert len(found.places) == 2
    # The field itself cannot but give both the same.
    assert record.updated[weak - 1] == pytest.approx(record.updated[n - weak], abs=1e-3)
    assert record.trust is not None
    assert record.trust.verdict != "trusted"
    assert any("cannot distinguish 2 places" in said for said in record.trust.unseen)


@needs_ccx
def test_a_soft_patch_of_a_plate_is_found_by_zones(tmp_path: Path) -> None:
    text = plate("S4")  # 3 x 2 shells
    assert "MATERIAL=A" in text
    (tmp_path / "plate.inp").write_text(text)
    weak = 5
    soft = "*MATERIAL, NAME=AW\n" + STEEL.format(young=0.6 * 70000.0)
    other = "*ELSET, ELSET=REST\n1, 2, 3, 4, 6\n*ELSET, ELSET=SOFT\n5\n"
    section = "*SHELL SECTION, ELSET=P, MATERIAL=A\n2.0\n"
    assert section in text
    both = "".join(
        section.replace("ELSET=P", f"ELSET={name}").replace("MATERIAL=A", f"MATERIAL={material}")
        for name, material in (("REST", "A"), ("SOFT", "AW"))
    )
    (tmp_path / "true.inp").write_text(text.replace(section, soft + other + both))
    truth = calculix_solver(tmp_path / "true.inp", ())
    measured(tmp_path, truth, 3, [2, 5, 7, 10, 11], [3])  # the fourth mode is in its plane
    field = "zones: 6, smoothing: total_variation"
    path = written(tmp_path, "plate.inp", "calculix", field, 1.0)
    campaign, record = updated(path)
    (found,) = record.fields
    assert record.parameters.names == tuple(f"E.zone{k}" for k in range(1, 7))
    zone = found.field.owners[found.field.elements.tolist().index(weak)]
    assert int(np.argmin(record.updated)) == zone
    assert found.places[0][0] == zone
    assert record.updated[zone] == pytest.approx(0.6, abs=0.1)
    assert len(campaign.splits) >= 5


def grid(nx: int, ny: int, soft: Sequence[int] = (), factor: float = 1.0) -> str:
    """nx x ny shells of 20 x 20 x 2, held along one edge."""

    def node(i: int, j: int) -> int:
        return j * (nx + 1) + i + 1

    rows = [(node(i, j), 20.0 * i, 20.0 * j, 0.0) for j in range(ny + 1) for i in range(nx + 1)]
    shells = [
        (j * nx + i + 1, node(i, j), node(i + 1, j), node(i + 1, j + 1), node(i, j + 1))
        for j in range(ny)
        for i in range(nx)
    ]
    text = "*NODE, NSET=NALL\n" + "".join(", ".join(map(str, row)) + "\n" for row in rows)
    for name, young, own in (
        ("A", 70000.0, [item for item in shells if item[0] not in soft]),
        ("AW", 70000.0 * factor, [item for item in shells if item[0] in soft]),
    ):
        if own:
            text += f"*ELEMENT, TYPE=S4, ELSET=E{name}\n"
            text += "".join(", ".join(map(str, row)) + "\n" for row in own)
            text += f"*MATERIAL, NAME={name}\n{STEEL.format(young=young)}"
            text += f"*SHELL SECTION, ELSET=E{name}, MATERIAL={name}\n2.0\n"
    held = "".join(f"{node(0, j)},1,6\n" for j in range(ny + 1))
    return f"{text}*BOUNDARY\n{held}*STEP\n*FREQUENCY\n10\n*END STEP\n"


@needs_ccx
def test_a_soft_patch_among_a_hundred_shells_is_found_within_its_standard_errors(
    tmp_path: Path,
) -> None:
    nx, ny, soft, factor = 12, 8, (41, 42, 53, 54), 0.6
    noise, shape_noise = 0.0005, 0.01
    (tmp_path / "plate.inp").write_text(grid(nx, ny))
    (tmp_path / "true.inp").write_text(grid(nx, ny, soft, factor))
    truth = calculix_solver(tmp_path / "true.inp", ())
    sensors = [j * (nx + 1) + i + 1 for j in range(0, ny + 1, 2) for i in range(2, nx + 1, 2)]
    exact = measured(tmp_path, truth, 8, sensors, [3])
    # The sixth mode is in the plane; what sensors across it see is rounding.
    seen = np.sqrt(np.mean(np.real(exact.mode_shapes) ** 2, axis=0))
    bends = seen > 1e-3 * seen.max()
    assert bends.sum() >= 7
    random = np.random.default_rng(5)
    shapes = np.real(exact.mode_shapes)[:, bends]
    shapes = shapes + shape_noise * seen[bends] * random.standard_normal(shapes.shape)
    hz = exact.frequencies_hz[bends] * (1.0 + noise * random.standard_normal(bends.sum()))
    noisy = mode_set(hz, shapes, exact.nodes, exact.components)
    write_modes_csv(tmp_path / "measured.csv", range(1, hz.size + 1), noisy)
    path = written(tmp_path, "plate.inp", "calculix", "zones: elements", 1.0)
    settings = (
        f"residuals.frequency_deviation={noise}",
        f"residuals.shape_deviation={shape_noise}",
    )
    campaign, record = updated(path, *settings)
    (found,) = record.fields
    own = found.field
    weak = np.isin(own.elements[np.argsort(own.owners)], soft)
    changes = record.updated - 1.0
    # The place: what changed most is one of the four, and the centre of what got softer lies
    # within an element of theirs.
    assert weak[int(np.argmin(changes))]
    lost = np.where(changes < 0.5 * changes.min(), -changes, 0.0)
    centre = lost @ own.centres[np.argsort(own.owners)] / lost.sum()
    expected = own.centres[np.isin(own.elements, soft)].mean(axis=0)
    assert np.abs(centre - expected)[:2].max() < 20.0
    # The size: of 96 values at most 5 % lie two standard errors off, none four. Smoothing
    # draws the patch to its start, which they hold.
    off = np.abs(changes + (1.0 - factor) * weak) / record.standard_errors
    assert np.mean(off < 2.0) >= 0.95
    assert off.max() < 4.0
    # Noise is all that is left: neither is a fault of the model suspected, nor are the deviations
    # said to be too large.
    verdict = record_verdict(record)
    assert verdict is not None
    assert not verdict.form.suspected
    assert not verdict.form.overstated
    assert record.runs.sensitivity == 4
    assert set(record.best.sensitivity_methods) == {"semi_analytic"}
    # Derivatives for the patch as one, by the modes of the matrices on both sides.
    engine = job_engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    _, matrix = evaluator.evaluate(0, campaign.start, None, alone=False)
    assert matrix is not None
    step = 0.01
    low, high = (
        evaluator.evaluate(0, campaign.start + side * weak, None, alone=True)[0].residual.values
        for side in (-step, step)
    )
    slope = matrix.values @ weak
    # Central differences err by the third derivative, (1 %)^2 of the slope at most a few times.
    scale = np.abs(slope).max()
    np.testing.assert_allclose(slope, (low - high) / (2.0 * step), atol=2e-3 * scale)


def tower(n_bays: int, weak: int = 0, factor: float = 1.0) -> str:
    """A plane lattice of two legs, rungs and diagonals, bars alone; bar 0 is none."""
    grids, bars = [], []
    for level in range(n_bays + 1):
        for leg, x in enumerate((0.0, 800.0 - 40.0 * level)):
            held = "123456" if level == 0 else "3456"
            grids.append(f"GRID,{2 * level + leg + 1},,{x},{1000.0 * level},0.,,{held}")
    for level in range(n_bays):
        a, b, c, d = (2 * level + k for k in (1, 2, 3, 4))
        bars += [(a, c), (b, d), (c, d), (a, d)]
    rods = [
        f"CROD,{number},{2 if number == weak else 1},{one},{other}"
        for number, (one, other) in enumerate(bars, start=1)
    ]
    props = ["PROD,1,1,200.", "MAT1,1,2.1+5,,.3,7.85-9"]
    if weak:
        props += ["PROD,2,2,200.", f"MAT1,2,{2.1e5 * factor:.1f},,.3,7.85-9"]
    head = ["SOL 103", "CEND", "METHOD = 1", "DISP = ALL", "BEGIN BULK", "EIGRL,1,,,6"]
    return "\n".join([*head, *grids, *rods, *props, "ENDDATA", ""])


@needs_mystran
def test_the_weak_bar_of_a_lattice_tower_is_found_by_mystran(tmp_path: Path) -> None:
    weak = 8  # the diagonal of the second bay
    (tmp_path / "tower.bdf").write_text(tower(4))
    (tmp_path / "true.bdf").write_text(tower(4, weak, 0.5))
    truth = mystran_solver(tmp_path / "true.bdf", ())
    measured(tmp_path, truth, 5, [3, 6, 8, 9], [1, 2])
    path = written(tmp_path, "tower.bdf", "mystran", "smoothing: sparse", 1.0)
    path.write_text(path.read_text().replace("material: A", "material: 1"))
    _, record = updated(path)
    (found,) = record.fields
    assert len(record.parameters) == 16
    assert record.runs.sensitivity < 16  # a job a colour, not a bar
    assert record.parameters.names[found.field.columns[found.places[0][0]]] == f"E.{weak}"
    assert int(np.argmin(record.updated)) == weak - 1
    assert record.updated[weak - 1] == pytest.approx(0.5, abs=0.05)


@needs_ccx
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("quantity: youngs_modulus", "quantity: poissons_ratio"), "does not report which"),
        (("zones: 3", "zones: 30"), "30 zones of 4 elements"),
        (("update: {", "update: {step: trust_region, "), "and needs `pulled_to_initial`"),
        (("{name: E, ", '{name: E, expression: "2", '), "a field has its own values"),
        (("parameters:\n", "parameters:\n  - {name: E.zone2, quantity: density, material: A}\n"),
         "line 5: a zone of a field has the same name E.zone2"),
    ],
)  # fmt: skip
def test_a_field_that_cannot_be_is_told_with_its_line(
    tmp_path: Path, change: tuple[str, str], expected: str
) -> None:
    (tmp_path / "beam.inp").write_text(beam(4, [0]))
    (tmp_path / "measured.csv").write_text("mode, 1\nfrequency_hz, 100\n")
    path = written(tmp_path, "beam.inp", "calculix", "zones: 3", 0.0)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(CampaignError) as error:
        load_campaign(path)
    assert expected in str(error.value), str(error.value)
