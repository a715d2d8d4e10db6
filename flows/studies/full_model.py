"""A campaign's or deck's model as matrices, seen by what is measured or kept of it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.regular_file import read_regular
from modetune.adapters.solver import MatrixAnalysis
from modetune.core.algebra.factor_room import FactorRoom
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.condensation.measured_unknowns import MeasuredModel, measured_model
from modetune.core.correlation.correlation import Shapes
from modetune.core.errors import CampaignError
from modetune.core.modes import COMPONENTS, Floats, Integers, dof_name
from modetune.core.parameters import Values
from modetune.core.updating.observation import Observation, sensor_observation
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.execution import solve_jobs
from modetune.flows.jobs.job import Job
from modetune.flows.studies.study import is_file

Dofs = list[tuple[int, int]]
#: NODE, NODE.z or NODE.xyz, and NODE.123 as Nastran has it; a range of nodes in place of NODE.
MASTERS = re.compile(r"(\d{1,18})(?:-(\d{1,18}))?(?:\.([1-6]+|r?[xyz]|[xyz]+))?", re.IGNORECASE)
#: Nodes that a range may name at most.
RANGE = 10_000


@dataclass(frozen=True)
class FullModel:
    """The matrices of a model at parameter values, and how motions of nodes follow from them.

    room: what factors of them may take.
    """

    campaign: Campaign
    matrices: MatrixResult
    room: FactorRoom

    @cached_property
    def stiffness(self) -> sparse.csr_array:
        return self.matrices.stiffness

    @cached_property
    def mass(self) -> sparse.csr_array:
        return self.matrices.mass

    def observation(self, nodes: Integers, components: Integers) -> Observation:
        """Motions of nodes, (n,), by the equations."""
        return self.campaign.case.solver.deck.observation(self.matrices, nodes, components)

    @cached_property
    def every_motion(self) -> tuple[Integers, Integers, sparse.csr_array]:
        """All motions that nodes have: nodes, components (n_dof,), and their matrix.

        Motions that the matrices lack (rotations of expanded shells) are left out.
        """
        summary = self.campaign.case.solver.deck.summary
        ids = np.array(sorted(summary.node_ids), dtype=np.int64)
        kinds = np.array(sorted(summary.components), dtype=np.int64)
        nodes, components = np.repeat(ids, kinds.size), np.tile(kinds, ids.size)
        found = self.observation(nodes, components)
        known = np.flatnonzero(~found.unknown)
        return nodes[known], components[known], sparse.csr_array(found.matrix[known])

    def seen(self, wanted: Observation, names: Dofs) -> tuple[MeasuredModel, Integers]:
        """The model with these motions for unknowns; places of those that can move.

        Raises CampaignError if the matrices lack a motion, or if no motion is free.
        """
        unknown = [dof_name(names[place]) for place in np.flatnonzero(wanted.unknown)]
        if unknown:
            raise CampaignError(
                f"the matrices of {self.campaign.solver_name} do not contain the motion of "
                f"{', '.join(unknown[:5])}; leave it out"
            )
        moving = np.flatnonzero(~wanted.held).astype(np.int64)
        if not moving.size:
            raise CampaignError("every measured or kept degree of freedom is held in place")
        rows = sparse.csr_array(wanted.matrix[moving])
        return measured_model(self.stiffness, self.mass, rows), moving


def full_model(campaign: Campaign, values: Values) -> FullModel:
    """One matrix job, the store first. Raises CampaignError, SolverError, StoreError."""
    solver = campaign.case.solver
    if not solver.offers.matrices or not solver.deck.summary.matrix_shapes:
        raise CampaignError(
            f"this requires stiffness and mass matrices, which {solver.program.name} does not give "
            f"for {solver.deck.summary.name}; `--solver` names another program, or `--solver "
            "matrices` with a file that names matrices (docs/models.md)"
        )
    engine = job_engine(campaign)
    (outcome,) = solve_jobs(engine, [Job(values, MatrixAnalysis())], "matrices")
    return FullModel(campaign, outcome.result(MatrixResult), engine.room)


def sensor_names(campaign: Campaign) -> Dofs:
    """Names of the test's sensors. Raises CampaignError where it has no shapes."""
    sensors = campaign.case.sensors
    if not sensors.n_sensors or not campaign.case.test.has_shapes:
        raise CampaignError(
            f"{campaign.file}: this requires measured mode shapes; name a test that has them"
        )
    return list(zip(sensors.nodes.tolist(), sensors.components.tolist(), strict=True))


def by_sensors(model: FullModel) -> Observation:
    """What the test's sensors see, by the equations."""
    return sensor_observation(model.campaign.case.sensors, model.observation)


def masters_of(campaign: Campaign, given: str) -> Dofs:
    """The degrees of freedom of a text `12.z,13,20-25.xyz`, or of a file with one or more a line.

    A node without component is its translations. Raises CampaignError with the place of each
    problem.
    """
    path = Path(given)
    items = [(f"--masters {given!r}", part.strip()) for part in given.split(",")]
    if is_file(given):
        try:
            lines = read_regular(path).decode("utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise CampaignError(f"{path} cannot be read as text: {error}") from error
        items = [
            (f"{path}, line {count}", part)
            for count, line in enumerate(lines, start=1)
            for part in re.split(r"[\s,;]+", line.partition("#")[0].strip())
        ]
    found: dict[tuple[int, int], None] = {}
    problems: list[str] = []
    for where, part in items:
        if part:
            _add_master(campaign, where, part, found, problems)
    if problems or not found:
        raise CampaignError(problems or f"--masters {given!r} names no degree of freedom")
    return list(found)


def _add_master(
    campaign: Campaign, where: str, part: str, found: dict[tuple[int, int], None], out: list[str]
) -> None:
    summary = campaign.case.solver.deck.summary
    match = MASTERS.fullmatch(part)
    if match is None:
        out.append(f"{where}: {part!r} is not NODE, NODE.z, NODE.xyz or a range FIRST-LAST.xyz")
        return
    first, last = int(match[1]), int(match[2] or match[1])
    if not first <= last < first + RANGE:
        out.append(f"{where}: {part!r} is not a range of 1 to {RANGE} nodes")
        return
    nodes = [node for node in range(first, last + 1) if node in summary.node_ids]
    if not nodes:
        out.append(f"{where}: the model has no node {part.partition('.')[0]}")
    kinds = _components(match[3])
    if match[3] is None:
        kinds &= summary.components
    elif not kinds <= summary.components:
        out.append(f"{where}: nodes of this model have no component {match[3]}")
    for node in nodes:
        found |= dict.fromkeys((node, component) for component in sorted(kinds))


def _components(text: str | None) -> frozenset[int]:
    if text is None:
        return frozenset((1, 2, 3))
    if text.isdecimal():
        return frozenset(map(int, text))
    low = text.lower()
    return frozenset(COMPONENTS.index(name) + 1 for name in ([low] if "r" in low else low))


def dof_arrays(names: Dofs) -> tuple[Integers, Integers]:
    """Nodes and components of names, (n,) each."""
    pairs = np.array(names, dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def relative(difference: Shapes, reference: Shapes) -> Floats:
    """Length of each column of a difference over that of its reference, NaN where that is zero."""
    lengths = np.linalg.norm(reference, axis=0)
    return np.asarray(np.linalg.norm(difference, axis=0) / np.where(lengths > 0, lengths, np.nan))
