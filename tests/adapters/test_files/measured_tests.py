"""Tests (measurements) made up at random, of every shape that the formats can hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from modetune.core.measurement.measurement import MeasuredFrfs, Measurement, TestGeometry
from modetune.core.measurement.response_functions import Response
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet

KINDS: tuple[Response, ...] = ("receptance", "mobility", "accelerance")


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a test shall have."""

    seed: int
    n_nodes: int = 9
    n_modes: int = 3
    rotations: bool = False
    damping: bool = True
    turned: bool = True
    metres: float = 0.001
    coherent: bool = True
    kind: Response = "accelerance"
    parts: tuple[bool, bool, bool] = (True, True, True)


wanted_tests = st.builds(
    Wanted,
    seed=st.integers(0, 2**32 - 1),
    n_nodes=st.integers(3, 12),
    n_modes=st.integers(1, 4),
    rotations=st.booleans(),
    damping=st.booleans(),
    turned=st.booleans(),
    metres=st.sampled_from([float("nan"), 1.0, 0.001, 0.3048, 1e-6]),
    coherent=st.booleans(),
    kind=st.sampled_from(KINDS),
    parts=st.tuples(st.booleans(), st.booleans(), st.booleans()).filter(any),
)


def made(wanted: Wanted) -> Measurement:
    """A test with these properties."""
    random = np.random.default_rng(wanted.seed)
    nodes = np.sort(random.choice(10**7, wanted.n_nodes, replace=False) + 1)
    has_modes, has_points, has_functions = wanted.parts
    return Measurement(
        _modes(wanted, nodes, random) if has_modes else None,
        _points(wanted, nodes, random) if has_points else None,
        _functions(wanted, nodes, random) if has_functions else None,
    )


def _modes(wanted: Wanted, nodes: Integers, random: np.random.Generator) -> MeasuredModes:
    components = np.arange(1, 7 if wanted.rotations else 4)
    dofs = np.array([(node, component) for node in nodes for component in components])
    dofs = dofs[np.sort(random.choice(len(dofs), max(2, 2 * len(dofs) // 3), replace=False))]
    modes = ModeSet(
        frequencies_hz=np.sort(random.uniform(1.0, 900.0, wanted.n_modes)),
        mode_shapes=random.normal(size=(len(dofs), wanted.n_modes)) * 10 ** random.uniform(-9, 9),
        nodes=dofs[:, 0],
        components=dofs[:, 1],
        damping_ratios=random.uniform(1e-4, 0.1, wanted.n_modes if wanted.damping else 0),
    )
    numbers = random.choice(50, wanted.n_modes, replace=False) + 1
    return MeasuredModes(tuple(numbers.tolist()), modes)


def rotation(random: np.random.Generator) -> Floats:
    """A random right-handed frame."""
    frame, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return np.asarray(frame * np.sign(np.linalg.det(frame)))


def _points(wanted: Wanted, nodes: Integers, random: np.random.Generator) -> TestGeometry:
    frames = np.tile(np.eye(3), (nodes.size, 1, 1))
    if wanted.turned:
        frames[::2] = [rotation(random) for _ in nodes[::2]]
    return TestGeometry(
        nodes=nodes,
        coordinates=random.normal(size=(nodes.size, 3)) * 10 ** random.uniform(-3, 5),
        frames=frames,
        lines=np.column_stack([nodes[:-1], nodes[1:]]),
        faces=np.column_stack([nodes[:-2], nodes[1:-1], nodes[2:]]),
        metres=wanted.metres,
    )


def _functions(wanted: Wanted, nodes: Integers, random: np.random.Generator) -> MeasuredFrfs:
    n_lines, n = 7, nodes.size
    shape = n_lines, n
    even = random.uniform() < 0.5
    steps = np.full(n_lines, 0.25) if even else random.uniform(0.5, 2.0, n_lines)
    return MeasuredFrfs(
        kind=wanted.kind,
        frequencies_hz=np.cumsum(steps),
        values=random.normal(size=shape) + 1j * random.normal(size=shape),
        nodes=nodes,
        components=random.integers(1, 7, n),
        signs=random.choice([-1.0, 1.0], n),
        reference_nodes=np.full(n, nodes[0]),
        reference_components=np.full(n, 3),
        reference_signs=random.choice([-1.0, 1.0], n),
        coherences=random.uniform(size=shape) if wanted.coherent else np.zeros((0, 0)),
    )
