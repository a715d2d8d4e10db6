"""The rod program behind modetune's solver seam: a whole adapter, for frequencies and shapes."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.process import LOG, log_tail
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    Deck,
    ModalAnalysis,
    ModelSummary,
    Number,
    Rendered,
    Solver,
)
from modetune.core.errors import ModelError, NoResult, SolverCrashed, SolverRejected
from modetune.core.mesh import Cells, Mesh
from modetune.core.modes import mode_set
from modetune.core.parameters import Parameter, Values
from modetune.core.updating.job_results import ModalResult

PROGRAM = Path(__file__).with_name("rod.py")
#: Which word of a `material` line is the number of each quantity.
FIELDS = {"youngs_modulus": 2, "density": 3}


# --8<-- [start:deck]
@dataclass(frozen=True)
class RodDeck(Deck):
    """A rod's deck and the parameters that edit it; edited, it is a text."""

    file: Path
    text: str
    parameters: tuple[Parameter, ...]

    @property
    def summary(self) -> ModelSummary:
        n_nodes = self.mesh().nodes.size
        nodes, components = frozenset(range(1, n_nodes + 1)), frozenset({1})
        return ModelSummary(self.file.stem, nodes, components, n_nodes - 1, solid_shapes=False)

    def mesh(self) -> Mesh:
        x = [0.0]
        for _, line in self._lines("rod"):
            x += (x[-1] + float(line[2]) * np.arange(1, int(line[3]) + 1) / int(line[3])).tolist()
        nodes = np.arange(1, len(x) + 1)
        bars = Cells("line", nodes[:-1], np.column_stack([nodes[:-1], nodes[1:]]))
        return Mesh(nodes, np.column_stack([x, 0.0 * nodes, 0.0 * nodes]), (bars,))

    def numbers(self, parameter: Parameter) -> list[Number]:
        if parameter.quantity not in FIELDS:
            raise ModelError(f"a rod has no {parameter.quantity}")
        field, found = FIELDS[parameter.quantity], []
        lines = {line[1]: (row, line) for row, line in self._lines("material")}
        for target in parameter.targets:
            if target not in lines:
                raise ModelError(f"{self.file} has no {target}")
            row, line = lines[target]
            found.append(Number((row, field), float(line[field]), f"{self.file}, line {row + 1}"))
        return found

    def edited(self, values: Values) -> str:
        """Its text with the parameters' numbers multiplied; other lines as they were."""
        lines = self.text.splitlines()
        for parameter in self.parameters:
            factor = values.get(parameter.name, 1.0)
            for number in self.numbers(parameter) if factor != 1.0 else ():
                (row, field), words = number.place, lines[number.place[0]].split()
                words[field] = repr(number.value * factor)
                lines[row] = " ".join(words)
        return "\n".join(lines) + "\n"

    def write_updated(self, values: Values, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / self.file.name).write_text(self.edited(values))
        return folder / self.file.name

    def _lines(self, kind: str) -> list[tuple[int, list[str]]]:
        lines = enumerate(map(str.split, self.text.splitlines()))
        return [(row, line) for row, line in lines if line[:1] == [kind]]


# --8<-- [end:deck]


# --8<-- [start:program]
class RodProgram:
    """The rod program: how a job is written, started and read."""

    name = "rod"
    capabilities = Capabilities(strain_energies=False, matrices=False)

    def version(self) -> str:
        found = re.search(r'^VERSION = "(.+)"$', PROGRAM.read_text(), re.MULTILINE)
        return found[1] if found else "unknown"

    def render(self, deck: str, analysis: Analysis) -> Rendered:
        assert isinstance(analysis, ModalAnalysis)
        ask = json.dumps({"modes": analysis.n_modes, "nodes": list(analysis.nodes)})
        text = re.sub(r"[ \t]+", " ", deck)  # blanks change no number
        # "reader" is raised by hand when the same output is read to other numbers.
        content = {"solver": self.name, "version": self.version(), "reader": 1,
                   "deck": hashlib.sha256(text.encode()).hexdigest(), "ask": ask}  # fmt: skip
        return Rendered.of_texts(content, {"job.rod": text.encode(), "job.ask": ask.encode()})

    def command(self, threads: int) -> Command:
        arguments = (sys.executable, "-P", str(PROGRAM), "job")
        return Command(arguments, (("OMP_NUM_THREADS", str(threads)),))

    # --8<-- [end:program]

    # --8<-- [start:result]
    def read(self, deck: str, analysis: Analysis, folder: Path, return_code: int) -> ModalResult:
        assert isinstance(analysis, ModalAnalysis)
        lines = (folder / LOG).read_text(errors="replace").splitlines()
        fatal = [line for line in lines if line.startswith("FATAL")]
        if fatal:
            raise SolverRejected(f"the rod program refused the deck (job in {folder}): {fatal[0]}")
        if return_code != 0 or "ROD FINISHED" not in lines:
            raise SolverCrashed(f"the rod program broke off in {folder}\n{log_tail(folder)}")
        try:
            told = json.loads((folder / "job.modes").read_text())
            eigenvalues = np.array(told["eigenvalues"], dtype=np.float64)
            shapes = np.array([told["shapes"][str(node)] for node in analysis.nodes])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise NoResult(f"{folder / 'job.modes'} is missing, cut or damaged") from error
        modes = mode_set(
            np.sqrt(eigenvalues) / (2.0 * np.pi), shapes.reshape(-1, eigenvalues.size),
            analysis.nodes, np.ones(len(analysis.nodes)), normalisation="mass",
        )  # fmt: skip
        without = np.zeros((0, eigenvalues.size)), np.full(eigenvalues.size, np.nan)
        return ModalResult(eigenvalues, modes, (), *without, float(told["mass"]))


# --8<-- [end:result]


# --8<-- [start:solver]
def rod_solver(file: Path, parameters: tuple[Parameter, ...]) -> Solver:
    """The rod program for a deck. Raises ModelError where the deck cannot be read."""
    try:
        return Solver(RodDeck(file, file.read_text(encoding="utf-8"), parameters), RodProgram())
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"{file} cannot be read: {error}") from error


# --8<-- [end:solver]
