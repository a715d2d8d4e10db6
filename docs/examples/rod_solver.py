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
    Footprint,
    ModalAnalysis,
    ModelSummary,
)
from modetune.core.errors import ModelError, NoResult, SolverCrashed, SolverRejected
from modetune.core.keys import Json
from modetune.core.mesh import Cells, Mesh
from modetune.core.modes import Integers, mode_set
from modetune.core.observation import Observation, nothing_known
from modetune.core.parameters import Parameter, Values
from modetune.core.results import MatrixResult, ModalResult, Result

PROGRAM = Path(__file__).with_name("rod.py")
#: Which word of a `material` line is the number of each quantity.
FIELDS = {"youngs_modulus": 2, "density": 3}


# --8<-- [start:model]
@dataclass(frozen=True)
class RodSolver:
    """The rod program bound to one deck and the parameters that edit it."""

    deck: Path
    text: str
    parameters: tuple[Parameter, ...]

    name = "rod"
    reader_version = 1  # raised by hand when the same output is read to other numbers
    capabilities = Capabilities(strain_energies=False, matrices=False)

    @property
    def model(self) -> ModelSummary:
        nodes = self._stations().size
        return ModelSummary(
            name=self.deck.stem, node_ids=frozenset(range(1, nodes + 1)),
            components=frozenset({1}), n_elements=nodes - 1, solid_shapes=False,
        )  # fmt: skip

    def mesh(self) -> Mesh:
        x = self._stations()
        nodes = np.arange(1, x.size + 1)
        ends = np.column_stack([nodes[:-1], nodes[1:]])
        coordinates = np.column_stack([x, 0.0 * x, 0.0 * x])
        return Mesh(nodes, coordinates, (Cells("line", nodes[:-1], ends),))

    def version(self) -> str:
        found = re.search(r'^VERSION = "(.+)"$', PROGRAM.read_text(), re.MULTILINE)
        return found[1] if found else "unknown"

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        found = []
        owners: dict[tuple[str, str], str] = {}
        for parameter in parameters:
            if parameter.quantity not in FIELDS:
                found.append(f"parameter {parameter.name}: a rod has no {parameter.quantity}")
            for target in parameter.targets:
                if target not in self._materials():
                    found.append(f"parameter {parameter.name}: {self.deck} has no {target}")
                first = owners.setdefault((target, parameter.quantity), parameter.name)
                if first != parameter.name:
                    found.append(f"{first} and {parameter.name} change the same number")
        return found

    # --8<-- [end:model]

    # --8<-- [start:parameters]
    def deck_value(self, parameter: Parameter) -> float:
        return float(self._materials()[parameter.targets[0]][FIELDS[parameter.quantity]])

    def written(self, parameter: Parameter, value: float) -> float:
        return value  # the deck takes all digits

    def wave_speeds(self) -> dict[str, float]:
        words = self._materials().values()
        return {name: (float(e) / float(rho)) ** 0.5 for _, name, e, rho in words}

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        return ()  # the program prints no strain energies

    def is_linear(self, parameter: Parameter) -> bool:
        return True  # stiffness in E, mass in the density

    def footprint(self, parameter: Parameter) -> Footprint | None:
        return None  # the program gives no matrices

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return nothing_known(nodes.size, matrices.nodes.size)

    # --8<-- [end:parameters]

    # --8<-- [start:job]
    def content(self, values: Values, analysis: Analysis) -> Json:
        assert isinstance(analysis, ModalAnalysis)
        edited = re.sub(r"\s+", " ", self._edited(values))  # blanks change no number
        return {
            "solver": self.name,
            "version": self.version(),
            "reader": self.reader_version,
            "deck": hashlib.sha256(edited.encode()).hexdigest(),
            "n_modes": analysis.n_modes,
            "nodes": list(analysis.nodes),
        }

    def write(self, values: Values, analysis: Analysis, folder: Path) -> None:
        assert isinstance(analysis, ModalAnalysis)
        ask = {"modes": analysis.n_modes, "nodes": list(analysis.nodes)}
        (folder / "job.rod").write_text(self._edited(values))
        (folder / "job.ask").write_text(json.dumps(ask))

    def command(self, threads: int) -> Command:
        arguments = (sys.executable, "-P", str(PROGRAM), "job")
        return Command(arguments, (("OMP_NUM_THREADS", str(threads)),))

    # --8<-- [end:job]

    # --8<-- [start:result]
    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        assert isinstance(analysis, ModalAnalysis)
        lines = (folder / LOG).read_text(errors="replace").splitlines()
        fatal = [line for line in lines if line.startswith("FATAL")]
        if fatal:
            raise SolverRejected(f"the rod program refused {self.deck}: {fatal[0]}")
        if return_code != 0 or "ROD FINISHED" not in lines:
            raise SolverCrashed(f"the rod program broke off in {folder}\n{log_tail(folder)}")
        try:
            told = json.loads((folder / "job.modes").read_text())
            eigenvalues = np.array(told["eigenvalues"], dtype=np.float64)
            shapes = np.array([told["shapes"][str(node)] for node in analysis.nodes])
            mass = float(told["mass"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise NoResult(f"{folder / 'job.modes'} is missing, cut or damaged") from error
        return ModalResult(
            eigenvalues=eigenvalues,
            modes=mode_set(
                np.sqrt(eigenvalues) / (2.0 * np.pi), shapes.reshape(-1, eigenvalues.size),
                analysis.nodes, np.ones(len(analysis.nodes)), normalisation="mass",
            ),
            groups=(), strain_energies=np.zeros((0, eigenvalues.size)),
            total_strain_energy=np.full(eigenvalues.size, np.nan), mass=mass,
        )  # fmt: skip

    def write_updated(self, values: Values, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / self.deck.name).write_text(self._edited(values))
        return folder / self.deck.name

    # --8<-- [end:result]

    # --8<-- [start:deck]
    def _materials(self) -> dict[str, list[str]]:
        """Words of each `material` line by the material's name."""
        lines = [line.split() for line in self.text.splitlines()]
        return {words[1]: words for words in lines if words[:1] == ["material"]}

    def _stations(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Where the nodes lie along x, (n_nodes,)."""
        sizes = [
            float(words[2]) / int(words[3])
            for words in map(str.split, self.text.splitlines())
            if words[:1] == ["rod"]
            for _ in range(int(words[3]))
        ]
        return np.concatenate([[0.0], np.cumsum(sizes)])

    def _edited(self, values: Values) -> str:
        """The deck with the parameters' values; lines of which none changes stay as they are."""
        materials = self._materials()
        changed: dict[str, list[str]] = {}
        for parameter in self.parameters:
            factor = values.get(parameter.name, 1.0)
            for target in parameter.targets if factor != 1.0 else ():
                words = changed.setdefault(target, list(materials[target]))
                field = FIELDS[parameter.quantity]
                words[field] = repr(float(words[field]) * factor)
        lines = []
        for line in self.text.splitlines():
            start = line.split()[:2]
            edit = changed.get(start[1]) if start[:1] == ["material"] else None
            lines.append(" ".join(edit) if edit else line)
        return "\n".join(lines) + "\n"


def rod_solver(deck: Path, parameters: tuple[Parameter, ...]) -> RodSolver:
    """The rod program for a deck. Raises ModelError where the deck cannot be read."""
    try:
        return RodSolver(deck, deck.read_text(encoding="utf-8"), parameters)
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"{deck} cannot be read: {error}") from error


# --8<-- [end:deck]
