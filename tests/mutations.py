"""Kinds of input, what reads each, and readings of their mutations within limits.

`mutators.py` has the mutations. All are seeded: a kind, a seed and a number give one file again.
`test_mutations.py` reads some of each kind, `benchmarks/mutations.py` many.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from unittest import mock

import numpy as np
from scipy import sparse

from modetune.adapters import process
from modetune.adapters.abaqus.solver import assembly_solver
from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.frd import count_frd
from modetune.adapters.calculix.matrices import read_matrices
from modetune.adapters.calculix.results import read_messages, read_modal
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.command.settings import CommandSettings
from modetune.adapters.command.solver import command_solver, read_results
from modetune.adapters.matrices.job import read_result, write_job
from modetune.adapters.matrices.matrix_files import write_matrix
from modetune.adapters.matrices.model import MatrixModel
from modetune.adapters.matrices.program import CLOSING_MARK, RESULT, run_job
from modetune.adapters.matrices.solver import matrices_solver
from modetune.adapters.nastran.design import read_dscm2
from modetune.adapters.nastran.dialect import DECK
from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.solver import NastranProgram, nastran_solver
from modetune.adapters.process import LOG
from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis, SensitivityAnalysis, Solver
from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import read_histories, read_measurement
from modetune.adapters.test_files.modes_csv import read_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError, ModetuneError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.parameters import Parameter
from modetune.core.storage.campaign_record import read_record, write_record
from modetune.core.storage.store import Entry, Store
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import campaign_schema
from modetune.flows.campaign.site import SITE_VARIABLE, site_run
from modetune.flows.studies.init.draft import init_campaign
from tests.adapters import fake_nastran
from tests.adapters.abaqus.decks import bracket
from tests.adapters.calculix.test_model import DECK as CALCULIX_DECK
from tests.adapters.calculix.test_results import ANALYSIS
from tests.adapters.nastran.test_f06 import small
from tests.adapters.nastran.test_model import DECK as NASTRAN_DECK
from tests.adapters.nastran.test_solver import PARAMETERS as CHAIN_PARAMETERS
from tests.adapters.nastran.test_solver import deck as chain_deck
from tests.adapters.test_dmig import beam, binary, punched
from tests.adapters.test_files.measured_tests import Wanted, made
from tests.adapters.test_files.result_decks import ladder
from tests.adapters.test_files.test_mat import DOF, FN, NODE, PHI, ZETA, save_73
from tests.adapters.test_files.test_repeated_csv import TABLE as REPEATED
from tests.adapters.test_files.test_solver_results import nastran_hdf5, punch
from tests.adapters.test_files.test_tables import GERMAN
from tests.adapters.test_files.test_universal_broken import WHOLE as UNIVERSAL_DATASETS
from tests.adapters.test_files.universal_text import binary_58
from tests.core.storage.test_campaign_record import record
from tests.core.storage.test_store import KEY, modal
from tests.flows.studies.test_init_design import BEAM, PLATE, TRUSS
from tests.mutators import (
    CARDS,
    DATASETS,
    KEYWORDS,
    MAIN,
    PAGES,
    ROWS,
    Files,
    Mutator,
    mat_file,
    of_archive,
    of_hdf5,
    of_mat,
    of_records,
    of_text,
    of_workbook,
    of_yaml,
    spoil_bytes,
    workbook,
)
from tests.one_matrix import read_matrix
from tests.shaft_line import DECK as SHAFT_DECK
from tests.shaft_line import NODES as SHAFT_NODES

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests" / "adapters" / "data"
SIX_MASS = ROOT / "configs" / "six_mass"
#: No reading may take more processor time than this, or more memory above what the process had.
LONGEST_S, MOST_BYTES = 5.0, 500 << 20
#: None may wait longer than this.
LONGEST_WAIT_S = 60.0
#: A plate of two shells on a beam, a spring, a mass and a rigid element.
PLATE_DECK = """SOL 103
CEND
METHOD = 1
SPC = 1
BEGIN BULK
PARAM,POST,-1
EIGRL,1,,,6
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,2.,0.,0.
GRID,4,,0.,1.,0.
GRID,5,,1.,1.,0.
GRID,6,,2.,1.,0.
GRID,7,,3.,1.,0.
GRID,8,,2.,1.,.5
CQUAD4,1,1,1,2,5,4
CQUAD4,2,1,2,3,6,5
CBAR,3,2,6,7,0.,0.,1.
PSHELL,1,1,.01,1,,1
PBAR,2,1,1.E-3,1.E-7,2.E-7,1.5E-7
MAT1,1,70.E9,,.3,2700.
CELAS2,4,1.E5,7,3
CONM2,5,8,,2.
RBE2,6,6,123456,8
SPC1,1,123456,1,4
ENDDATA
"""


OTHER_ROWS = of_text(ROWS)


@dataclass(frozen=True)
class Kind:
    """A kind of input: a good one's bytes, what reads it, and what mutates its structure.

    believed: whether a spoilt one may be read as something. share: of the mutations that others
    get, for what is slow.
    """

    good: bytes
    read: Callable[[Path], object]
    structure: Mutator = OTHER_ROWS
    believed: bool = True
    share: float = 1.0


def mutation(kind: Kind, seed: int, number: int) -> Files:
    """A mutation by its number: one in three of bytes, the others of the file's structure."""
    random = np.random.default_rng([seed, number, zlib.crc32(kind.good)])
    return (kind.structure if number % 3 else spoil_bytes)(kind.good, random)


class Hang(BaseException):
    """Raised into a reader that takes too long."""


class Greed(BaseException):
    """Raised where a reader took too much memory."""


@contextmanager
def bounded() -> Iterator[None]:
    """Limit the processor time, the time and the memory of what is read within."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Hang

    clocks = {signal.SIGPROF: signal.ITIMER_PROF, signal.SIGALRM: signal.ITIMER_REAL}
    before = {number: signal.signal(number, stop) for number in clocks}
    limit = _memory("VmRSS") + MOST_BYTES
    Path("/proc/self/clear_refs").write_text("5")  # the peak is that of now
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_WAIT_S)
    try:
        yield
    finally:
        for number, clock in clocks.items():
            signal.setitimer(clock, 0.0)
            signal.signal(number, before[number])
    if _memory("VmHWM") > limit:
        raise Greed


def _memory(name: str) -> int:
    """What this process holds (VmRSS) or has held at most (VmHWM), bytes."""
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) * 1024


def read_all(kind: Kind, folder: Path, seed: int, numbers: Iterable[int]) -> Counter[str]:
    """Read mutations of a kind in a folder; how they ended. Anything but a sentence is raised,
    with the files kept beside."""
    ends: Counter[str] = Counter()
    for number in numbers:
        files = mutation(kind, seed, number)
        if files == {MAIN: kind.good}:
            continue
        for name, data in files.items():
            (folder / name).write_bytes(data)
        try:
            with bounded():
                kind.read(folder / MAIN)
            ends["read"] += 1
        except ModetuneError as error:
            ends[type(error).__name__ if str(error).strip() else "no sentence"] += 1
        except BaseException as fault:
            kept = folder / f"fault-{seed}-{number}"
            kept.mkdir(exist_ok=True)
            for name, data in files.items():
                (kept / name).write_bytes(data)
            fault.add_note(f"mutation {number} of seed {seed}, kept in {kept}")
            raise
        finally:
            for name in files:
                (folder / name).unlink()
    return ends


def use(solver: Solver, parameters: tuple[Parameter, ...], folder: Path) -> None:
    """What a campaign asks of a solver before anything runs, and the decks of its jobs."""
    nodes = tuple(sorted(solver.deck.summary.node_ids)[:3])
    solver.deck.wave_speeds()
    if solver.deck.problems(parameters):
        return
    values = {parameter.name: 1.1 for parameter in parameters}
    for parameter in parameters:
        solver.deck.deck_value(parameter)
        solver.deck.energy_sets(parameter)
        solver.deck.is_linear(parameter)
    folder.mkdir(exist_ok=True)
    for analysis in (ModalAnalysis(4, nodes), MatrixAnalysis()):
        if isinstance(analysis, ModalAnalysis) or solver.program.capabilities.matrices:
            solver.render(values, analysis).write(folder)
    solver.deck.write_updated(values, folder / "updated")


def parameter(name: str, quantity: str, by: str, target: str) -> Parameter:
    return Parameter(name, quantity, by, (target,), 0.5, 2.0, 0.2)  # type: ignore[arg-type]  # words of tests


CALCULIX = (
    parameter("E", "youngs_modulus", "material", "AL"),
    parameter("t", "thickness", "elset", "PLATE"),
    parameter("k", "spring_stiffness", "elset", "GROUND"),
    parameter("m", "mass", "elset", "BALLAST"),
)
ASSEMBLY = (
    parameter("E", "youngs_modulus", "material", "STEEL"),
    parameter("m", "mass", "elset", "_PICKEDSET7_INERTIA-1_MASS_"),
)
NASTRAN = (
    parameter("E", "youngs_modulus", "material", "1"),
    parameter("rho", "density", "material", "1"),
)


def read_calculix(path: Path) -> None:
    use(calculix_solver(path, CALCULIX), CALCULIX, path.parent / "jobs")


def read_assembly(path: Path) -> None:
    use(assembly_solver(read_deck(path), ASSEMBLY), ASSEMBLY, path.parent / "jobs")


def read_nastran(path: Path) -> None:
    with mock.patch.object(NastranProgram, "version", return_value="2024.1"):
        use(nastran_solver(path, NASTRAN, "msc"), NASTRAN, path.parent / "jobs")


def read_translated(path: Path) -> None:
    use(translated_solver(path, NASTRAN), NASTRAN, path.parent / "jobs")


def read_campaign(path: Path) -> None:
    for name in ("six_mass.yaml", "measured.csv"):
        if not (path.parent / name).exists():
            (path.parent / name).write_bytes((SIX_MASS / name).read_bytes())
    campaign = load_campaign(path)
    use(campaign.case.solver, campaign.parameters.parameters, path.parent / "jobs")


def read_spring_mass(path: Path) -> None:
    for name in ("campaign.yaml", "measured.csv"):
        if not (path.parent / name).exists():
            (path.parent / name).write_bytes((SIX_MASS / name).read_bytes())
    campaign = load_campaign(path.parent / "campaign.yaml", [f"model.deck={path.name}"])
    use(campaign.case.solver, campaign.parameters.parameters, path.parent / "jobs")


def read_stiffness(path: Path) -> None:
    folder = path.parent / "matrices"
    folder.mkdir(exist_ok=True)
    for ending in ("dof", "mas"):
        (folder / f"clamped.{ending}").write_bytes((DATA / f"clamped.{ending}").read_bytes())
    (folder / "clamped.sti").write_bytes(path.read_bytes())
    read_matrices(folder, "clamped")


def read_names(path: Path) -> None:
    folder = path.parent / "matrices"
    folder.mkdir(exist_ok=True)
    for ending in ("sti", "mas"):
        (folder / f"clamped.{ending}").write_bytes((DATA / f"clamped.{ending}").read_bytes())
    (folder / "clamped.dof").write_bytes(path.read_bytes())
    read_matrices(folder, "clamped")


def read_entry(path: Path) -> None:
    store = Store(path.parent / "store")
    place = store.path(KEY)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(path.read_bytes())
    if store.get(KEY) is None:
        raise ModelError("no hit")


def read_report(path: Path) -> None:
    process._finished(path.read_bytes(), "the job", path.parent, 1.0)
    process._number(path.read_bytes())


def read_test(suffix: str) -> Callable[[Path], object]:
    """A reader of a test file that has this suffix."""

    def read(path: Path) -> object:
        named = path.with_name(f"test{suffix}")
        named.write_bytes(path.read_bytes())
        return read_measurement([named])

    return read


def read_named(name: str) -> Callable[[Path], object]:
    """A reader of a matrix in a file of this name, of a dataset of it after a colon."""

    def read(path: Path) -> object:
        (path.parent / name.partition(":")[0]).write_bytes(path.read_bytes())
        return read_matrix(path.parent, name)

    return read


def read_draft(suffix: str, *settings: str, node: int = 1) -> Callable[[Path], object]:
    """A reader of a deck by which a campaign is drafted; node: a sensor's, which must move."""

    def read(path: Path) -> object:
        deck, test = path.with_name(f"deck{suffix}"), path.with_name("draft_test.csv")
        deck.write_bytes(path.read_bytes())
        test.write_text(DRAFT_TEST.replace("1.z", f"{node}.z"))
        return init_campaign(deck, [test], settings, path.with_name("draft.yaml"), force=True)

    return read


def read_template(path: Path) -> object:
    """The deck of a program without an adapter."""
    path.with_name("nodes.csv").write_text(SHAFT_NODES)
    solver = command_solver(path, SHAFT, SHAFT_PROGRAM)
    use(solver, SHAFT, path.parent / "jobs")
    return solver


def read_history(path: Path) -> object:
    return read_histories([path])


def read_model(path: Path) -> object:
    """A model of matrices, by its file."""
    for name in ("K.mtx", "M.mtx"):
        if not (path.parent / name).exists():
            write_matrix(path.parent, name, TRIDIAGONAL)
    solver = matrices_solver(path, ())
    use(solver, (), path.parent / "jobs")
    return solver


def read_dofs(path: Path) -> object:
    """The names of the unknowns of a model of matrices."""
    for name, matrix in (("K.mtx", TRIDIAGONAL), ("M.mtx", TRIDIAGONAL)):
        if not (path.parent / name).exists():
            write_matrix(path.parent, name, matrix)
    model = path.parent / "model.yaml"
    model.write_text(f"stiffness: K.mtx\nmass: M.mtx\ndofs: {path.name}\n")
    return matrices_solver(model, ())


def read_matrices_job(path: Path) -> object:
    """What the embedded solver left of a modal job."""
    folder = path.parent / "job"
    if not folder.exists():
        folder.mkdir()
        (folder / LOG).write_text(f"{CLOSING_MARK}\n")
    (folder / RESULT).write_bytes(path.read_bytes())
    analysis = ModalAnalysis(2, (1, 2, 3))
    return read_result(matrix_model(), {}, analysis, folder, 0)


def read_site(path: Path) -> object:
    with mock.patch.dict(os.environ, {SITE_VARIABLE: str(path)}):
        return site_run()


def matrix_model() -> MatrixModel:
    nodes, x = np.arange(1, SIZE + 1), np.ones(SIZE, dtype=np.int64)
    return MatrixModel("chain", TRIDIAGONAL, sparse.csr_array(np.eye(SIZE)), nodes, x, {})


def geometry() -> TestGeometry:
    points = WHOLE_TEST.geometry
    assert points is not None
    return points


def solve_sensitivities(folder: Path) -> None:
    """A job of SOL 200 by the program that stands for Nastran."""
    (folder / "model.bdf").write_text(chain_deck())
    solver = nastran_solver(folder / "model.bdf", CHAIN_PARAMETERS, "msc")
    with mock.patch.object(NastranProgram, "version", return_value="2024.1"):
        solver.render({}, SensitivityAnalysis(2, ("m", "k_root"))).write(folder)
    with contextlib.chdir(folder):
        fake_nastran.run(Path(DECK), "good")


def in_folder(write: Callable[[Path], object], name: str) -> bytes:
    """The bytes of the file of this name that something writes into a folder."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        return (Path(folder) / name).read_bytes()


def stored() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        store.put(Entry(KEY, modal(), "calculix", "2.20", 1.5), "{}")
        return store.path(KEY).read_bytes()


def matrix_bytes(name: str, matrix: sparse.csr_array) -> bytes:
    return in_folder(lambda folder: write_matrix(folder, name, matrix), name.partition(":")[0])


def matrices_job_bytes() -> bytes:
    def run(folder: Path) -> None:
        write_job(matrix_model(), {}, ModalAnalysis(2, (1, 2, 3)), folder)
        with (folder / LOG).open("w") as log:
            run_job(folder, log)

    return in_folder(run, RESULT)


SIZE = 6
TRIDIAGONAL = sparse.csr_array(2 * np.eye(SIZE) - np.eye(SIZE, k=1) - np.eye(SIZE, k=-1))
SYMMETRIC = "%%MatrixMarket matrix coordinate real symmetric\n% a chain\n3 3 5\n" + "".join(
    f"{entry}\n" for entry in ("1 1 2.0", "2 1 -1.0", "2 2 2.0", "3 2 -1.0", "3 3 1.0")
)
ARRAY = "%%MatrixMarket matrix array real general\n2 2\n2.0\n-1.0\n-1.0\n1.0\n"
#: One brick with the shapes of two modes, as ccx writes them.
FRD = """    1C
    1UUSER
    2C                             4                                     1
 -1         1 0.00000E+00 0.00000E+00 0.00000E+00
 -1         2 1.00000E+00 0.00000E+00 0.00000E+00
 -1         3 0.00000E+00 1.00000E+00 0.00000E+00
 -1         4 0.00000E+00 0.00000E+00 1.00000E+00
 -3
    3C                             1                                     1
 -1         1    3    0    1
 -2         1         2         3         4
 -3
""" + 2 * """    1PSTEP                         1           1           1
  100CL  101 1.00000E+01           4                     2    1MODAL       1
 -4  DISP        4    1
 -5  D1          1    2    1    0
 -1         1 0.00000E+00 1.00000E+00 0.00000E+00
 -1         2 0.00000E+00 2.00000E+00 0.00000E+00
 -1         3 0.00000E+00 3.00000E+00 0.00000E+00
 -1         4 0.00000E+00 4.00000E+00 0.00000E+00
 -3
""" + " 9999\n"  # fmt: skip
#: A campaign with most sections.
ALL_KEYS = """name: all
model: {deck: six_mass.yaml, solver: matrices, units: m-kg-s, rigid_modes: 0}
test: {modes: measured.csv, use: [2, 3], unmatched: drop, hold_out: [4]}
parameters:
  - {name: k1, quantity: spring_stiffness, elset: k1, bounds: [0.5, 2.0]}
  - {name: k2, quantity: spring_stiffness, elset: [k2, k3], deviation: 0.1}
  - {name: m, quantity: mass, elset: m2, bounds: [0.5, 1.5]}
residuals:
  frequency_deviation: {2: 0.01, others: 0.002}
  shape_weight: 0.1
  mac: {weight: 1.0}
  mass_properties: {mass: {target: 15.0, deviation: 0.1}}
update: {step: regularised, e1: {frequency: 0.01, mac: 0.9}, e2: 0.002, max_iterations: 5}
sensitivity: {method: semi_analytic, between: broyden}
run: {parallel: 2, retries: 2, timeout_s: 60, licences: {nastran: 1}, keep: 3}
report: {nodes: 50}
"""
SITE = b"run:\n  engine: slurm\n  slurm: {partition: batch, account: dynamics}\n  parallel: 4\n"
WHOLE_TEST = made(Wanted(7))


#: Unknowns that the drafts' decks have.
DRAFT_TEST = "mode,1,2\nfrequency_hz,10,20\n1.z,1,0.5\n2.z,0.5,-1\n"
SHAFT_PROGRAM = CommandSettings(
    "shaft", ("{python}", "{deck}"), "2.5", "nodes.csv", results="t.csv"
)
SHAFT = tuple(
    Parameter(name, "number", "placeholder", (name,), 0.1, 10.0, 0.2)
    for name in ("k_engine", "k_shaft", "propeller")
)
SHAFT_MODES = b"mode,1,2\nfrequency_hz,10.5,20.25\n1.rx,1,0.5\n2.rx,0.5,-1\n6.rx,0.25,0.125\n"
HISTORY = "time,1.x [m/s^2],2.x [m/s^2],7.x [N]\n" + "".join(
    f"{step / 64},{np.sin(step):.6f},{np.cos(step / 3):.6f},{step % 7}\n" for step in range(400)
)
CALCULIX_LINES, NASTRAN_LINES = of_text(KEYWORDS), of_text(CARDS)
PRINTED, HDF5 = of_text(PAGES), of_hdf5
CAMPAIGN = of_yaml(campaign_schema())
#: Two modes of four sensors, a row a sensor, with what was measured besides.
SHEET = [
    ["mode", 1, 2],
    ["frequency_hz", 10.5, 20.25],
    ["damping_ratio", 0.01, 0.02],
    *([f"{node}.z", 1.0 / node, -0.5 * node] for node in (1, 2, 3, 11)),
    ["environment temperature_C", 21.5],
]


KINDS = {
    "campaign": Kind((SIX_MASS / "campaign.yaml").read_bytes(), read_campaign, CAMPAIGN),
    "campaign of all kinds": Kind(ALL_KEYS.encode(), read_campaign, CAMPAIGN),
    "spring-mass deck": Kind(
        (SIX_MASS / "six_mass.yaml").read_bytes(), read_spring_mass, of_yaml()
    ),
    "model of matrices": Kind(b"stiffness: K.mtx\nmass: M.mtx\n", read_model, of_yaml()),
    "test": Kind((SIX_MASS / "measured.csv").read_bytes(), read_modes_csv),
    "table of a spreadsheet": Kind(GERMAN.encode("latin-1"), read_test(".csv")),
    "repeated tests": Kind(REPEATED.encode(), read_test(".csv")),
    "time histories": Kind(HISTORY.encode(), read_history),
    "workbook": Kind(workbook(SHEET), read_test(".xlsx"), of_workbook),
    "MATLAB file": Kind(
        mat_file({"fn": FN, "zeta": ZETA, "phi": PHI, "dof": DOF, "node": NODE}),
        read_test(".mat"),
        of_mat,
    ),
    "MATLAB 7.3": Kind(
        in_folder(lambda folder: save_73(folder / "m.mat", fn=FN, phi=PHI, dof=DOF), "m.mat"),
        read_test(".mat"),
        HDF5,
        share=0.07,
    ),
    "CalculiX deck": Kind(CALCULIX_DECK.encode(), read_calculix, CALCULIX_LINES),
    "assembly": Kind(bracket()[0].encode(), read_assembly, CALCULIX_LINES, share=0.5),
    "Nastran deck": Kind(NASTRAN_DECK.encode(), read_nastran, NASTRAN_LINES),
    "translated Nastran deck": Kind(PLATE_DECK.encode(), read_translated, NASTRAN_LINES),
    "draft for CalculiX": Kind(
        CALCULIX_DECK.encode(), read_draft(".inp"), CALCULIX_LINES, share=0.3
    ),
    "draft for MYSTRAN": Kind(ladder().encode(), read_draft(".bdf"), NASTRAN_LINES, share=0.3),
    **{
        f"draft by SOL 200, {name}": Kind(
            deck.encode(), read_draft(".bdf", node=node), NASTRAN_LINES, share=0.3
        )
        for name, deck, node in (("truss", TRUSS, 4), ("plate", PLATE, 1), ("beam", BEAM, 1))
    },
    "template": Kind(SHAFT_DECK.encode(), read_template),
    "modes of a command": Kind(SHAFT_MODES, read_results),
    "CalculiX modes": Kind(
        (DATA / "bar.dat").read_bytes(), lambda path: read_modal(path, ANALYSIS, 0.0), PRINTED
    ),
    "CalculiX log": Kind(
        (DATA / "turned_element.log").read_bytes(),
        lambda path: read_messages(path.read_text(errors="replace")),
    ),
    "CalculiX matrix": Kind((DATA / "clamped.sti").read_bytes(), read_stiffness),
    "CalculiX equations": Kind((DATA / "clamped.dof").read_bytes(), read_names),
    "OP2": Kind((DATA / "nastran" / "rods.op2").read_bytes(), read_op2, of_records),
    "OP2 as a test": Kind(
        (DATA / "nastran" / "rods.op2").read_bytes(), read_test(".op2"), of_records
    ),
    "F06": Kind(small().encode(), read_f06, PRINTED),
    "F06 as a test": Kind(small().encode(), read_test(".f06"), PRINTED),
    "punch file": Kind(punch().encode(), read_test(".pch"), PRINTED),
    "Nastran's HDF5": Kind(
        in_folder(lambda folder: nastran_hdf5(folder / "n.h5"), "n.h5"),
        read_test(".h5"),
        HDF5,
        share=0.07,
    ),
    "store entry": Kind(stored(), read_entry, HDF5, believed=False),
    "record": Kind(
        in_folder(lambda folder: write_record(folder / "campaign.h5", record()), "campaign.h5"),
        read_record,
        HDF5,
        believed=False,
    ),
    "Nastran sensitivities": Kind(
        in_folder(solve_sensitivities, "job.op2"), read_dscm2, of_records
    ),
    "CalculiX shapes": Kind(FRD.encode(), count_frd, PRINTED),
    "CalculiX shapes as a test": Kind(FRD.encode(), read_test(".frd"), PRINTED),
    "universal file": Kind(
        in_folder(lambda folder: write_universal(folder / "t.uff", WHOLE_TEST), "t.uff"),
        read_test(".uff"),
        of_text(DATASETS),
        share=0.3,
    ),
    "universal datasets": Kind(
        UNIVERSAL_DATASETS.encode(), read_test(".unv"), of_text(DATASETS), share=0.5
    ),
    "binary universal file": Kind(
        binary_58(np.arange(6.0), (1, 1, 2, 2), (6, 3, 1, 0.0, 1.0)),
        read_test(".uff"),
        of_text(DATASETS),
        share=0.5,
    ),
    "points": Kind(
        in_folder(lambda folder: write_geometry_csv(folder / "p.csv", geometry()), "p.csv"),
        read_test(".csv"),
    ),
    "test as HDF5": Kind(
        in_folder(lambda folder: write_test_hdf5(folder / "t.h5", WHOLE_TEST), "t.h5"),
        read_test(".h5"),
        HDF5,
        believed=False,
    ),
    "Matrix Market": Kind(SYMMETRIC.encode(), read_named("K.mtx")),
    "Matrix Market array": Kind(ARRAY.encode(), read_named("A.mtx")),
    "npz matrix": Kind(matrix_bytes("K.npz", TRIDIAGONAL), read_named("K.npz"), of_archive),
    "HDF5 matrix": Kind(
        matrix_bytes("K.h5:K", TRIDIAGONAL), read_named("K.h5:K"), HDF5, share=0.07
    ),
    "OUTPUT4": Kind(matrix_bytes("K.op4:K", TRIDIAGONAL), read_named("K.op4:K")),
    "binary OUTPUT4": Kind(binary("K", np.eye(5)), read_named("K.op4:K"), of_records),
    "DMIG": Kind(punched("KAAX", *beam(3)[::2]).encode(), read_named("K.pch:KAAX"), NASTRAN_LINES),
    "unknowns": Kind(b"# names\n7.x\n7.rz\n12.3\n13.y\n14.1\n15.z\n", read_dofs),
    "matrices result": Kind(matrices_job_bytes(), read_matrices_job),
    "site file": Kind(SITE, read_site, of_yaml()),
    "supervisor's report": Kind(
        b'{"error": "", "return_code": 0, "cpu_s": 0.25, "peak_memory_bytes": 1048576, '
        b'"disk_bytes": 0}\n',
        read_report,
    ),
}
