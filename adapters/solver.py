"""The seam between modetune and a finite element solver.

An adapter has a `Deck`, which reads and edits a model's file, and a `Program`, which writes jobs of
an edited deck, names the command that runs them, and reads their output.
It never starts a process (`process.py` does) and never decides what to run (the flows do). To add a
solver, write a folder with the two and name it in `flows/campaign/solvers`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import numpy as np

from modetune.adapters.deck_numbers import Number, refusals
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.algebra.rigid_modes import RigidByHand, count_rigid_modes
from modetune.core.errors import ModelError
from modetune.core.mesh import NOTHING_FIXED, Fixed, Mesh, shortest_length
from modetune.core.modes import Integers
from modetune.core.parameters import Parameter, Quantity, TargetKind, Values
from modetune.core.storage.files import make_folder
from modetune.core.storage.keys import Json
from modetune.core.updating.damping_model import DampingModel
from modetune.core.updating.job_results import ModalResult, Result
from modetune.core.updating.observation import Observation, nothing_known
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.static_model import LoadCase

R = TypeVar("R", bound=Result)


@dataclass(frozen=True, slots=True)
class ModalAnalysis:
    """Normal modes: the lowest n_modes (rigid ones counted), shapes at these nodes.

    groups: strain energies wanted, a name and the element sets it sums.
    """

    n_modes: int
    nodes: tuple[int, ...]
    groups: tuple[tuple[str, tuple[str, ...]], ...] = ()


@dataclass(frozen=True, slots=True)
class MatrixAnalysis:
    """The assembled stiffness and mass matrices."""


@dataclass(frozen=True, slots=True)
class SensitivityAnalysis:
    """Derivatives of the lowest n_modes (rigid ones counted) by the solver itself.

    parameters: names, in the order of the result's columns. nodes: where derivatives of shapes
    are wanted, empty for eigenvalues alone; their degrees of freedom come in the order in which
    a modal analysis at the same nodes has them.
    """

    n_modes: int
    parameters: tuple[str, ...]
    nodes: tuple[int, ...] = ()


Analysis = ModalAnalysis | MatrixAnalysis | SensitivityAnalysis


@dataclass(frozen=True, slots=True)
class ModalCase:
    """A subcase or step of a deck that has modes of its own.

    key: of the campaign's `model` that chooses it; about: what distinguishes it, may be empty;
    default: whether it counts without a choice.
    """

    key: Literal["subcase", "step"]
    number: int
    about: str
    default: bool = False

    def __str__(self) -> str:
        return f"{self.number} ({self.about})" if self.about else str(self.number)


#: Masses at the nodes alone, or spread as the displacements are; empty where nothing says so.
MassKind = Literal["", "lumped", "consistent", "consistent where elements have midside nodes"]


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a solver can give besides modes.

    tell_rigid: whether its strain energies of rigid modes are far below the rounding of their
    eigenvalues (stress times strain is, displacements times stiffness is not). matrix_modes:
    whether modes of its stored matrices may replace its own. masses: those of its jobs if they
    differ from the deck's. to_confirm: names of those above
    that count only where the self-test of this installation has passed them (`Solver.offers`).
    """

    strain_energies: bool
    matrices: bool
    tell_rigid: bool = False
    frequency_sensitivities: bool = False
    shape_sensitivities: bool = False
    matrix_modes: bool = False
    masses: MassKind = ""
    to_confirm: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Rendered:
    """A job as its program gets it: the deck edited once, for the key and for the run.

    content: everything of the model and the analysis that can change the numbers; the job's key
    is made of it. write: writes the input files into an empty folder. size: bytes that it holds.
    call: computes the result in this process, instead of files and a program.
    """

    content: Json
    write: Callable[[Path], None]
    size: int = 0
    call: Callable[[], Result] | None = None

    @classmethod
    def of_texts(cls, content: Json, texts: Mapping[str, bytes]) -> Rendered:
        """A job whose input files are these, by their names."""
        return cls(content, partial(_write_texts, texts), sum(map(len, texts.values())))

    @classmethod
    def of_call(cls, content: Json, call: Callable[[], Result]) -> Rendered:
        """A job that a function of this process computes; it raises SolverRejected."""
        return cls(content, partial(_write_texts, {}), call=call)


def _write_texts(texts: Mapping[str, bytes], folder: Path) -> None:
    for name, text in texts.items():
        make_folder((folder / name).parent)
        (folder / name).write_bytes(text)


#: Placeholder in a command's arguments for the folder in which it starts.
FOLDER = "\0folder\0"


@dataclass(frozen=True, slots=True)
class Command:
    """How a job is started: an argument list, and what the environment needs on top."""

    arguments: tuple[str, ...]
    environment: tuple[tuple[str, str], ...] = ()

    def started_in(self, folder: Path) -> Command:
        """The command with the folder's absolute path in place of FOLDER."""
        place = str(folder.resolve())
        return replace(self, arguments=tuple(a.replace(FOLDER, place) for a in self.arguments))


@dataclass(frozen=True, slots=True)
class ModelSummary:
    """What an adapter knows of its model without running it.

    node_ids: every node that carries results; components: which of 1..6 it has there.
    solid_shapes: whether each unknown of a node is one equation of the stored matrices (solids
    without dependent nodes), so that they are matrices of the nodes. matrix_shapes: whether shapes
    at nodes follow from the stored matrices (`Deck.observation`), as those of shells do too.
    file: what the model was read from, None where it is from no file. matrices: of a model that is
    matrices those for all values of some of its parameters, in their order.
    """

    name: str
    node_ids: frozenset[int]
    components: frozenset[int]
    n_elements: int
    solid_shapes: bool
    matrix_shapes: bool = False
    file: Path | None = None
    matrices: Callable[[tuple[Parameter, ...]], ParameterMatrices] | None = None


@dataclass(frozen=True, slots=True)
class AffectedElements:
    """What of the matrices a parameter moves, and in which powers of its relative value.

    elements: those of the solver's deck whose matrices it scales (parts of a model of matrices
    have numbers by their order). nodes: those of the model whose equations its part may touch,
    besides the unknowns inside of elements and knots there. stiffness, mass: which matrices it
    moves. powers: with theta the relative value, K = K_0 + sum over powers of theta^k K_k, and M
    alike, K_0 being what does not depend on it. proportional: whether it moves the stiffness alone
    and all of that of its elements is proportional to it. related: whether expressions of it move
    numbers too.
    """

    elements: frozenset[int]
    nodes: frozenset[int]
    stiffness: bool
    mass: bool
    powers: tuple[int, ...]
    proportional: bool
    related: bool = False


@dataclass(frozen=True, slots=True)
class Target:
    """Something of a deck that parameters may name: a material, a property, a set, elements.

    names: several if they are grouped. kind: its card; n_elements: their number; title: its name in
    a comment of the deck, mostly none.
    """

    by: TargetKind
    names: tuple[str, ...]
    kind: str
    n_elements: int
    title: str = ""


@dataclass(frozen=True, slots=True)
class DesignVariable:
    """A free value of a deck's own design model, in its units, and its limits there."""

    name: str
    initial: float
    lower: float
    upper: float
    where: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class DesignRelation:
    """A quantity that a deck's own design model gives by an expression of its variables."""

    name: str
    quantity: Quantity
    by: TargetKind
    targets: tuple[str, ...]
    item: int
    expression: str
    where: str


@dataclass(frozen=True, slots=True)
class DesignModel:
    """A deck's own design model, as SOL 200 has it.

    refused: a sentence for each of its cards that parameters cannot represent.
    """

    variables: tuple[DesignVariable, ...] = ()
    relations: tuple[DesignRelation, ...] = ()
    refused: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StatedUnits:
    """Units of length and force that a deck states, in metres and newtons.

    where: file, line and the statement.
    """

    metres: float
    newtons: float
    where: str


@dataclass(frozen=True, slots=True)
class Addition:
    """Something that a deck lacks, in its own units.

    A mass, or an inertia about each axis, at each of some nodes; a spring along a component, 1..6,
    from a node to the ground or to another node; a mass on such a spring from a node (`absorber`,
    with both values); springs in place of what holds some nodes (`support`) or ties them to a
    leader (`link`), along one component or, for 0, all that are held.
    """

    kind: Literal["mass", "inertia", "spring", "absorber", "support", "link"]
    nodes: tuple[int, ...]
    component: int
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class AddedCards:
    """The main file of a deck with an addition, and its numbers as parameters may name them.

    lines: those that are new; of the others some may have become comments. numbers: quantity, kind
    and names of the targets, value.
    """

    text: str
    lines: tuple[str, ...]
    numbers: tuple[tuple[Quantity, TargetKind, tuple[str, ...], float], ...]


@dataclass(frozen=True, slots=True)
class RigidLink:
    """Nodes that a rigid element, a body or a tie holds, and the node that they follow.

    leader: 0 if unknown; a tie has none.
    """

    leader: int
    nodes: tuple[int, ...]


#: A deck at some parameter values: what an adapter's deck makes for its program.
Edited = Any


class Deck(Protocol):
    """A model in its file, and the parameters that edit it.

    An adapter leaves out what it does not know: the methods with a body below are the defaults.
    """

    @property
    def summary(self) -> ModelSummary: ...

    def numbers(self, parameter: Parameter) -> list[Number]:
        """What the parameter moves, at least one but of a variable.

        Raises ModelError for why it can be nothing.
        """
        ...

    def edited(self, values: Values) -> Edited:
        """The deck at these relative values, as its program takes it. Raises ModelError."""
        ...

    def write_updated(self, values: Values, folder: Path) -> Path:
        """Write the user's deck with updated values, includes kept; returns the main file."""
        ...

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        """Why these parameters cannot be applied to the model, a sentence each; empty if fine."""
        return refusals(self.numbers, parameters)

    def splits(self) -> tuple[str, ...]:
        """Cards that were added to the deck for the elements of parameters, a sentence each."""
        return ()

    def deck_value(self, parameter: Parameter) -> float:
        """The value the deck gives the parameter's quantity (the first one if several).

        That of a variable, which is not in the deck, is its start.
        """
        if parameter.quantity == "variable":
            return 1.0 if parameter.values == "relative" else parameter.shown(1.0)
        return self.numbers(parameter)[0].value

    def mesh(self) -> Mesh:
        """Where the nodes that carry results lie, and the elements between them.

        Built when first asked for and kept. It holds every node of `summary.node_ids`, but is empty
        for a model that has no geometry (matrices). Shapes stand in global axes except at nodes
        of `Mesh.frames`. Raises ModelError.
        """
        return Mesh(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), ())

    def written(self, parameter: Parameter, value: float) -> float:
        """The relative value that an edited deck really holds; fields may have few digits."""
        return value

    def targets(self) -> tuple[Target, ...]:
        """What parameters may name, in the deck's order; that of a kind without numbers may be in.

        `problems` checks which quantities it has.
        """
        return ()

    def with_cards(self, addition: Addition) -> AddedCards:
        """Return the deck's main file with an addition, all else byte for byte.

        Raises ModelError where the deck or its format has no place for it.
        """
        raise ModelError(
            f"{self.summary.name}: masses and springs are added to CalculiX and Nastran decks, not "
            "to this model"
        )

    def with_parameters(self, more: tuple[Parameter, ...]) -> Deck:
        """Return the deck bound to more parameters, whose targets have elements of their own."""
        return self

    def released(self) -> tuple[Deck, tuple[RigidLink, ...]] | None:
        """Return the deck without its supports and rigid links, and these links.

        None where the adapter cannot take them out.
        """
        return None

    def design(self) -> DesignModel:
        """The deck's own design model, empty where it has none."""
        return DesignModel()

    def elastic_constants(self) -> dict[str, tuple[float, float]]:
        """E and density (0 where there is none) of each material that elements use."""
        return {}

    def stated_units(self) -> StatedUnits | None:
        """Return the units that the deck itself states, None where it states none."""
        return None

    def wave_speeds(self) -> dict[str, float]:
        """Root of E over density of each material that has both, in the deck's units."""
        known = self.elastic_constants().items()
        return {name: (young / density) ** 0.5 for name, (young, density) in known if density}

    def material_masses(self) -> dict[str, float]:
        """Return the approximate mass of each material of `wave_speeds`; empty if unknown."""
        return {}

    def largest_eigenvalue(self) -> float:
        """Return the approximate largest eigenvalue of the model, (rad/s)^2, 0 if unknown.

        That of a bar of one element, 12 (c / l)^2, as long as the shortest way between corners.
        """
        speed = max(self.wave_speeds().values(), default=0.0)
        try:
            return 12.0 * (speed / self.least_length()) ** 2 if speed else 0.0
        except ModelError:  # raised where the mesh itself is used
            return 0.0

    def least_length(self) -> float:
        """The least dimension of an element as its stiffness sees it. Raises ModelError."""
        return shortest_length(self.mesh())

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        """Element sets whose strain energy is proportional to the parameter; empty if none."""
        return ()

    def is_linear(self, parameter: Parameter) -> bool:
        """Whether the stiffness and mass matrices are linear in the parameter."""
        return False

    def masses(self) -> MassKind:
        """Which masses the deck asks for."""
        return ""

    def fixed(self) -> Fixed:
        """Return the components that cannot move, by node, as far as the deck says so."""
        return NOTHING_FIXED

    def preload(self) -> str:
        """What of the deck makes the stiffness depend on a state that is solved for first.

        With file and line; empty where nothing does. No parameter is linear then (stresses and
        contacts follow from all of them), and strain energies lack the part of the stresses.
        """
        return ""

    def affected_elements(self, parameter: Parameter) -> AffectedElements | None:
        """What of the matrices the parameter moves.

        None where they are not a sum of powers of its value (Poisson's ratio), where the number of
        equations depends on it, or where the solver has no matrices. Of two parameters that scale
        the same thing (the material and the thickness of one shell) the matrices have products,
        which this does not include.
        """
        return None

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        """Degrees of freedom (n_wanted,) in terms of the equations of stored matrices.

        They are those of a modal result: in the frames of `mesh`. All are unknown where the
        solver has no matrices.
        """
        return nothing_known(nodes.size, matrices.nodes.size)

    def freedoms(self, matrices: MatrixResult) -> tuple[Integers, Integers]:
        """Return the node of the mesh and the component 1..6 of each equation, (n_equations,)."""
        return matrices.nodes, matrices.components

    def undamped(self) -> str:
        """Why damping cannot be computed; empty where `damping` gives it."""
        return f"{self.summary.name}: no damping is known of this model"

    def losses(self) -> tuple[Parameter, ...]:
        """Factors on the stiffness of groups of elements that have a loss factor.

        They belong to no campaign: `edited` takes them with its parameters, as factors on these.
        """
        return ()

    def damping(self, base: MatrixResult) -> DampingModel:
        """What damps the model, in the equations of these matrices; its losses are of `losses`.

        Raises ModelError for what cannot be followed.
        """
        return DampingModel(())

    def load_case(self, number: int, values: Values | None = None) -> LoadCase:
        """The forces of a load case at relative values, the deck's own where left out.

        Raises ModelError for one that the deck has not.
        """
        raise ModelError(
            f"{self.summary.name}: load cases are read from CalculiX and Nastran decks, not from "
            "this model: give the forces by node instead"
        )


class Program(Protocol):
    """A finite element program: how a job is written for it, started and read."""

    @property
    def name(self) -> str: ...

    @property
    def capabilities(self) -> Capabilities: ...

    def version(self) -> str:
        """Raises SolverMissing."""
        ...

    def render(self, deck: Edited, analysis: Analysis) -> Rendered:
        """The job of an edited deck. Raises ModelError, SolverMissing (its key has the version)."""
        ...

    def command(self, threads: int) -> Command:
        """The command that runs the job written into the folder it is started in."""
        ...

    def read(self, deck: Edited, analysis: Analysis, folder: Path, return_code: int) -> Result:
        """Read a finished job. Raises SolverRejected or SolverCrashed where there is no result."""
        ...


@dataclass(frozen=True, slots=True)
class Solver:
    """A program bound to a model.

    rigid_modes: how many it has by hand, None where they are counted. confirmed: names of
    capabilities that the self-test of this installation has passed.
    """

    deck: Deck
    program: Program
    rigid_modes: RigidByHand | None = None
    confirmed: frozenset[str] = frozenset()

    @property
    def offers(self) -> Capabilities:
        """What may be taken of the program unasked: its capabilities without unconfirmed ones."""
        off: dict[str, Any] = dict.fromkeys(self.unconfirmed, False)
        return replace(self.program.capabilities, **off)

    @property
    def unconfirmed(self) -> tuple[str, ...]:
        """Capabilities that the self-test of this installation has not passed, in their order."""
        has = self.program.capabilities
        waiting = has.to_confirm - self.confirmed
        return tuple(
            item.name for item in fields(has) if item.name in waiting and getattr(has, item.name)
        )

    @property
    def other_masses(self) -> str:
        """That the program's masses are not those that the deck asks for; empty where they are."""
        asked, has = self.deck.masses(), self.program.capabilities.masses
        if not (asked and has) or asked == has:
            return ""
        return (
            f"the deck asks for {asked} masses (PARAM,COUPMASS), those of {self.program.name} are "
            f"{has}: frequencies differ where the mesh is coarse for the shape of a mode"
        )

    def render(self, values: Values, analysis: Analysis) -> Rendered:
        """The job at these values. Raises ModelError, SolverMissing."""
        return self.program.render(self.deck.edited(values), analysis)

    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        """Read a finished job. Raises SolverError where there is no result."""
        return self.counted(
            self.program.read(self.deck.edited(values), analysis, folder, return_code)
        )

    def counted(self, result: Result) -> Result:
        """A result with its number of rigid modes, where it has modes."""
        if not isinstance(result, ModalResult):
            return result
        energies = result.total_strain_energy
        if not self.program.capabilities.tell_rigid:
            energies = np.full(energies.size, np.nan)
        largest = self.deck.largest_eigenvalue
        return replace(result, n_rigid=count_rigid_modes(result.eigenvalues, energies, largest))

    def by_hand(self, result: R) -> R:
        """A result with the number of rigid modes that was given by hand, if one was.

        Raises CampaignError where its strain energies contradict that.
        """
        if self.rigid_modes is None or not isinstance(result, ModalResult):
            return result
        energies, found = result.total_strain_energy, result.n_rigid
        self.rigid_modes.check(result.eigenvalues, energies, found)
        return replace(result, n_rigid=self.rigid_modes.number)
