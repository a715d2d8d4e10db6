"""Spoilt input of every kind: it is read, or refused in a sentence; never a traceback or a hang.

A mutation flips bits, overwrites, cuts, repeats or swaps pieces of a good file, or puts words in
that readers stumble over. All is seeded. `benchmarks/mutations.py` does many more.
"""

from __future__ import annotations

import logging
import signal
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from unittest import mock

import numpy as np
import pytest

from modetune.adapters import process
from modetune.adapters.calculix.matrices import read_matrices
from modetune.adapters.calculix.results import read_messages, read_modal
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.solver import NastranProgram, nastran_solver
from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis, Solver
from modetune.adapters.test_files.modes_csv import read_modes_csv
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import CampaignError, ModelError, ModetuneError, NoResult
from modetune.core.parameters import Parameter
from modetune.core.storage.record_file import read_record, write_record
from modetune.core.storage.store import Entry, Store
from modetune.flows.campaign.campaign import load_campaign
from tests.adapters.test_calculix_model import DECK as CALCULIX_DECK
from tests.adapters.test_calculix_results import ANALYSIS
from tests.adapters.test_nastran_f06 import small
from tests.adapters.test_nastran_model import DECK as NASTRAN_DECK
from tests.core.storage.test_record import record
from tests.core.storage.test_store import KEY, modal

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "tests" / "adapters" / "data"
SIX_MASS = ROOT / "configs" / "six_mass"
MUTATIONS = 200
#: Generous: the slowest reader takes some milliseconds.
LONGEST_S = 20.0
#: What readers stumble over.
WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e999", b"99999999999999999999", b"\0", b"\xff\xfe", b"\n",
    b"\r", b",", b",,,,", b":", b"[", b"{", b"}", b"- ", b"&a", b"*a", b"!!x", b"'", b'"', b"#",
    b"$", b"*", b"**", b"=", b"\t", b" ", b"+", b"1.0-101", b"THRU", b"true", b"null", b"~", b"../",
    "½".encode(), "٣".encode(), b"\xc2\x85", b"\xe2\x80\xa8", b"1_000", b"0x10", b".",
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
    """A kind of input: a good one's bytes, what reads it, and what it may not be read as."""

    good: bytes
    read: Callable[[Path], object]
    believed: bool = True


def mutated(good: bytes, random: np.random.Generator) -> bytes:
    """A good file with one to four things done to it."""
    data = bytearray(good)
    for _ in range(int(random.integers(1, 5))):
        size = len(data) + 1
        place, length = int(random.integers(0, size)), int(random.integers(1, 40))
        other = int(random.integers(0, size))
        match int(random.integers(0, 9)):
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
            case _ if random.random() < 0.2:
                del data[place:]
            case _:
                data[place : place + length] = data[other : other + length]
    return bytes(data)


class Hang(BaseException):
    """Raised into a reader that takes too long."""


@contextmanager
def bounded() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def read_all(kind: Kind, path: Path, seed: int, count: int) -> Counter[str]:
    """Read mutations of a kind; how they ended. Anything but a sentence is raised, with the file
    kept beside."""
    ends: Counter[str] = Counter()
    for number in range(count):
        data = mutated(kind.good, np.random.default_rng([seed, number]))
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
NASTRAN = (
    parameter("E", "youngs_modulus", "material", "1"),
    parameter("rho", "density", "material", "1"),
)


def read_calculix(path: Path) -> None:
    use(calculix_solver(path, CALCULIX), CALCULIX, path.parent / "jobs")


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


def stored() -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        store.put(Entry(KEY, modal(), "calculix", "2.20", 1.5), "{}")
        return store.path(KEY).read_bytes()


def recorded() -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        write_record(Path(folder) / "campaign.h5", record())
        return (Path(folder) / "campaign.h5").read_bytes()


KINDS = {
    "campaign": Kind((SIX_MASS / "campaign.yaml").read_bytes(), read_campaign),
    "spring-mass deck": Kind((SIX_MASS / "six_mass.yaml").read_bytes(), read_spring_mass),
    "test": Kind((SIX_MASS / "measured.csv").read_bytes(), read_modes_csv),
    "CalculiX deck": Kind(CALCULIX_DECK.encode(), read_calculix),
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
    "record": Kind(recorded(), read_record, believed=False),
    "supervisor's report": Kind(
        b'{"error": "", "return_code": 0, "cpu_s": 0.25, "peak_memory_bytes": 1048576, '
        b'"disk_bytes": 0}\n',
        read_report,
    ),
}


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("name", KINDS)
def test_spoilt_input_is_read_or_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    kind = KINDS[name]
    ends = read_all(kind, tmp_path / "input", 1, MUTATIONS)
    assert sum(ends.values()) > 0.8 * MUTATIONS
    assert ends["no sentence"] == 0
    if not kind.believed:
        assert ends["read"] == 0


@pytest.mark.parametrize("name", KINDS)
def test_what_is_not_spoilt_is_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / "input"
    path.write_bytes(KINDS[name].good)
    KINDS[name].read(path)
    assert threading.active_count() < 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        KINDS[name].read(path)


#: Each value holds the one above nine times.
BOMB = "a0: &a0 [1, 1]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 15)
)


@pytest.mark.parametrize(
    "text",
    [
        "name: 2020-99-99",
        "? [a]\n: b",
        "name: &x [*x]",
        "name: " + "[" * 5000,
        BOMB,
        "name: \0",
        "<<: 3",
    ],
)
def test_yaml_that_is_endless_or_no_data_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "campaign.yaml"
    path.write_text(text)
    with bounded(), pytest.raises(CampaignError, match=r"campaign\.yaml"):
        load_campaign(path)


def test_a_shell_of_three_different_corners_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "input"
    path.write_text(PLATE_DECK.replace("CQUAD4,1,1,1,2,5,4", "CQUAD4,1,1,1,2,5,5"))
    with pytest.raises(ModelError, match="cannot be translated"):
        translated_solver(path, NASTRAN)


def test_a_matrix_line_without_its_row_is_no_result(tmp_path: Path) -> None:
    path, good = tmp_path / "input", KINDS["CalculiX matrix"].good
    path.write_bytes(good.replace(good.split(b"\n")[3].strip(), b", 1 2.5", 1))
    with pytest.raises(NoResult):
        read_stiffness(path)
