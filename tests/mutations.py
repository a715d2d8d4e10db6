"""Kinds of input with their readers, and mutations of good files.

A mutation flips bits, overwrites, cuts, repeats or swaps pieces of a good file, changes a number,
or puts words in that readers stumble over; of a text it also repeats, reorders, merges and removes
lines, grows numbers, and changes line ends and encoding. All is seeded. `test_mutations.py` does
some of each kind, `benchmarks/mutations.py` many.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import signal
import tempfile
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
from modetune.adapters.matrices.job import CLOSING_MARK, RESULT, read_result, run_job, write_job
from modetune.adapters.matrices.matrix_files import write_matrix
from modetune.adapters.matrices.model import MatrixModel
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
from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.modes_csv import read_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError, ModetuneError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.parameters import Parameter
from modetune.core.storage.campaign_record import read_record, write_record
from modetune.core.storage.store import Entry, Store
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.site import SITE_VARIABLE, site_run
from tests.adapters import fake_nastran
from tests.adapters.abaqus.decks import bracket
from tests.adapters.calculix.test_model import DECK as CALCULIX_DECK
from tests.adapters.calculix.test_results import ANALYSIS
from tests.adapters.nastran.test_f06 import small
from tests.adapters.nastran.test_model import DECK as NASTRAN_DECK
from tests.adapters.nastran.test_solver import PARAMETERS as CHAIN_PARAMETERS
from tests.adapters.nastran.test_solver import deck as chain_deck
from tests.adapters.test_files.measured_tests import Wanted, made
from tests.adapters.test_files.test_universal_broken import WHOLE as UNIVERSAL_DATASETS
from tests.adapters.test_files.universal_text import binary_58
from tests.core.storage.test_campaign_record import record
from tests.core.storage.test_store import KEY, modal
from tests.one_matrix import read_matrix

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests" / "adapters" / "data"
SIX_MASS = ROOT / "configs" / "six_mass"
#: No reading may take longer, or more memory than this above what the process had.
LONGEST_S, MOST_BYTES = 20.0, 2 << 30
#: What readers stumble over.
WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e999", b"99999999999999999999", b"\0", b"\xff\xfe", b"\n",
    b"\r", b",", b",,,,", b":", b"[", b"{", b"}", b"- ", b"&a", b"*a", b"!!x", b"'", b'"', b"#",
    b"$", b"*", b"**", b"=", b"\t", b" ", b"+", b"1.0-101", b"THRU", b"true", b"null", b"~", b"../",
    "½".encode(), "٣".encode(), b"\xc2\x85", b"\xe2\x80\xa8", b"1_000", b"0x10", b".",
)  # fmt: skip
#: What numbers are changed to.
NUMBERS = (
    b"0", b"-1", b"1", b"2", b"7", b"99999999", b"1000000000", b"2147483648", b"4294967296",
    b"9223372036854775808", b"1" + 30 * b"0", b"1e308", b"1e-320",
)  # fmt: skip


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


@dataclass(frozen=True)
class Kind:
    """A kind of input: a good one's bytes, and what reads it.

    believed: whether a spoilt one may be read as something. share: of the mutations that others
    get, for what starts a process.
    """

    good: bytes
    read: Callable[[Path], object]
    believed: bool = True
    share: float = 1.0


def mutated(good: bytes, random: np.random.Generator) -> bytes:
    """A good file with one to four things done to it."""
    data = bytearray(good)
    for _ in range(int(random.integers(1, 5))):
        size = len(data) + 1
        place, length = int(random.integers(0, size)), int(random.integers(1, 40))
        other = int(random.integers(0, size))
        match int(random.integers(0, 10)):
            case 0:
                data[place : place + 1] = bytes([int(random.integers(0, 256))])
            case 1 if place < len(data):
                data[place] ^= 1 << int(random.integers(0, 8))
            case 2:
                del data[place : place + length]
            case 3:
                data[place:place] = data[other : other + length]
            case 4 | 5:
                data[place:place] = WORDS[int(random.integers(0, len(WORDS)))]
            case 6:
                lines = data.split(b"\n")
                first, second = random.integers(0, len(lines), 2).tolist()
                lines[first], lines[second] = lines[second], lines[first]
                data = bytearray(b"\n").join(lines)
            case 7:
                lines = data.split(b"\n")
                del lines[int(random.integers(0, len(lines)))]
                data = bytearray(b"\n").join(lines)
            case 8:
                numbers = list(re.finditer(rb"\d+", data))
                if numbers:
                    one = numbers[int(random.integers(0, len(numbers)))]
                    data[one.start() : one.end()] = NUMBERS[int(random.integers(0, len(NUMBERS)))]
            case _ if random.random() < 0.2:
                del data[place:]
            case _:
                data[place : place + length] = data[other : other + length]
    return bytes(data)


def restructured(good: bytes, random: np.random.Generator) -> bytes:
    """A good text file with one or two things done to its lines, its numbers or its encoding."""
    data = good
    for _ in range(int(random.integers(1, 3))):
        lines = data.split(b"\n")
        one, other = (int(random.integers(0, len(lines))) for _ in range(2))
        match int(random.integers(0, 9)):
            case 0:
                lines.insert(other, lines[one])
            case 1:
                lines[one], lines[other] = lines[other], lines[one]
            case 2:
                del lines[one]
            case 3:
                lines[one : one + 2] = [b"".join(lines[one : one + 2])]
            case 4:
                lines[one] += b"," + lines[other]
            case 5:
                lines[one:one] = lines[one : one + int(random.integers(1, 8))] * 3
            case 6:
                numbers = list(re.finditer(rb"\d+", lines[one]))
                if numbers:
                    place = numbers[int(random.integers(0, len(numbers)))]
                    digits = b"7" * int(random.choice([9, 20, 400, 4_301]))
                    lines[one] = lines[one][: place.start()] + digits + lines[one][place.end() :]
            case 7:
                end = (b"\r", b"\r\n", b"\n\n", b"\x0c\n")[int(random.integers(0, 4))]
                lines = [end.join(lines)]
            case _:
                text = data.decode("latin-1")
                coding = ("utf-16", "utf-8-sig", "utf-32-be", "cp037")[int(random.integers(0, 4))]
                lines = [text.encode(coding, "replace")]
        data = b"\n".join(lines)
    return data


class Hang(BaseException):
    """Raised into a reader that takes too long."""


class Greed(BaseException):
    """Raised where a reader took too much memory."""


@contextmanager
def bounded() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise Hang

    before, memory = signal.signal(signal.SIGALRM, stop), peak_memory()
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    if peak_memory() > memory + MOST_BYTES:
        raise Greed


def peak_memory() -> int:
    """The most that this process has held so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def read_all(
    kind: Kind,
    path: Path,
    seed: int,
    numbers: Iterable[int],
    mutate: Callable[[bytes, np.random.Generator], bytes] = mutated,
) -> Counter[str]:
    """Read mutations of a kind; how they ended. Anything but a sentence is raised, with the file
    kept beside."""
    ends: Counter[str] = Counter()
    for number in numbers:
        data = mutate(kind.good, np.random.default_rng([seed, number]))
        if data == kind.good:
            continue
        path.write_bytes(data)
        try:
            with bounded():
                kind.read(path)
            ends["read"] += 1
        except ModetuneError as error:
            ends[type(error).__name__ if str(error).strip() else "no sentence"] += 1
        except BaseException as fault:
            kept = path.with_name(f"fault-{seed}-{number}")
            kept.write_bytes(data)
            fault.add_note(f"mutation {number} of seed {seed}, kept as {kept}")
            raise
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
SITE = b"run:\n  engine: slurm\n  slurm: {partition: batch, account: dynamics}\n  parallel: 4\n"
WHOLE_TEST = made(Wanted(7))


KINDS = {
    "campaign": Kind((SIX_MASS / "campaign.yaml").read_bytes(), read_campaign),
    "spring-mass deck": Kind((SIX_MASS / "six_mass.yaml").read_bytes(), read_spring_mass),
    "test": Kind((SIX_MASS / "measured.csv").read_bytes(), read_modes_csv),
    "CalculiX deck": Kind(CALCULIX_DECK.encode(), read_calculix),
    "assembly": Kind(bracket()[0].encode(), read_assembly, share=0.5),
    "Nastran deck": Kind(NASTRAN_DECK.encode(), read_nastran),
    "translated Nastran deck": Kind(PLATE_DECK.encode(), read_translated),
    "CalculiX modes": Kind(
        (DATA / "bar.dat").read_bytes(), lambda path: read_modal(path, ANALYSIS, 0.0)
    ),
    "CalculiX log": Kind(
        (DATA / "turned_element.log").read_bytes(),
        lambda path: read_messages(path.read_text(errors="replace")),
    ),
    "CalculiX matrix": Kind((DATA / "clamped.sti").read_bytes(), read_stiffness),
    "CalculiX equations": Kind((DATA / "clamped.dof").read_bytes(), read_names),
    "OP2": Kind((DATA / "nastran" / "rods.op2").read_bytes(), read_op2),
    "F06": Kind(small().encode(), read_f06),
    "store entry": Kind(stored(), read_entry, believed=False),
    "record": Kind(
        in_folder(lambda folder: write_record(folder / "campaign.h5", record()), "campaign.h5"),
        read_record,
        believed=False,
    ),
    "Nastran sensitivities": Kind(in_folder(solve_sensitivities, "job.op2"), read_dscm2),
    "CalculiX shapes": Kind(FRD.encode(), count_frd),
    "universal file": Kind(
        in_folder(lambda folder: write_universal(folder / "t.uff", WHOLE_TEST), "t.uff"),
        read_test(".uff"),
        share=0.3,
    ),
    "universal datasets": Kind(UNIVERSAL_DATASETS.encode(), read_test(".unv"), share=0.5),
    "binary universal file": Kind(
        binary_58(np.arange(6.0), (1, 1, 2, 2), (6, 3, 1, 0.0, 1.0)), read_test(".uff"), share=0.5
    ),
    "points": Kind(
        in_folder(lambda folder: write_geometry_csv(folder / "p.csv", geometry()), "p.csv"),
        read_test(".csv"),
    ),
    "test as HDF5": Kind(
        in_folder(lambda folder: write_test_hdf5(folder / "t.h5", WHOLE_TEST), "t.h5"),
        read_test(".h5"),
        believed=False,
    ),
    "Matrix Market": Kind(SYMMETRIC.encode(), read_named("K.mtx")),
    "Matrix Market array": Kind(ARRAY.encode(), read_named("A.mtx")),
    "npz matrix": Kind(matrix_bytes("K.npz", TRIDIAGONAL), read_named("K.npz")),
    "HDF5 matrix": Kind(matrix_bytes("K.h5:K", TRIDIAGONAL), read_named("K.h5:K"), share=0.05),
    "unknowns": Kind(b"# names\n7.x\n7.rz\n12.3\n13.y\n14.1\n15.z\n", read_dofs),
    "matrices result": Kind(matrices_job_bytes(), read_matrices_job),
    "site file": Kind(SITE, read_site),
    "supervisor's report": Kind(
        b'{"error": "", "return_code": 0, "cpu_s": 0.25, "peak_memory_bytes": 1048576, '
        b'"disk_bytes": 0}\n',
        read_report,
    ),
}
