"""Shells with any membrane, bending, coupling and shear stiffness, as degenerated solids.

ccx expands its own shells to solids of one material and the shell's thickness, has no laminates
beside masses and springs, and no shell whose bending is not its membrane's. So the solids are
written here, and the motion of their nodes is tied to displacement u and rotation theta of the
shell's nodes (Ahmad, Irons and Zienkiewicz 1970). With n the element's normal and z along it,

    membrane brick: u + c theta x n            (the same for all z, strains e + c k)
    bending brick:  n (n . u) + z theta x n    (strains z k, transverse shear g)

of height h and in-plane laws A / h and 12 D / h^3 with shear H / h: their energies are those of a
unit of area of the shell, whatever h is. Coupling takes two membrane bricks, at c and -c, of
A / 2 + B / 2 c and A / 2 - B / 2 c, and c^2 A less in bending. Offsets are in c. The bricks are
C3D20R and C3D15, as ccx takes them for S8R and S6.

Each brick stands on the mean plane of its element, and nodes beside that plane carry it on arms:
rigid motion is exact for warped elements too. The mass moves with a membrane brick: as Nastran's
shells it has no inertia against rotation.

A shell has no stiffness against rotation about its normal; Nastran gives it a little (K6ROT) or
takes it out (AUTOSPC). A mass, a beam or a rigid element on a shell node would turn freely. Here
that rotation is that of the shell's surroundings: theta n = sum (J^-1 n x r_i) u_i with J = sum
(r_i^2 I - r_i r_i) over the nodes of the adjacent elements, the rotation that fits their
displacements best, which is exact for rigid motion and stiffens nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modetune.adapters.nastran.shell_laws import law_of
from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.freedoms import Form, Freedoms, difference, total, trimmed
from modetune.adapters.translation.shells import Edges, SetsOf, Shell, own_thickness
from modetune.core.modes import Floats

#: Height of the bricks as a share of the usual edge: what the comparison of masses sees of it, in
#: the inertia of a single element, is its square.
HEIGHT = 0.01
#: Shells whose normals are nearer than this (cosine, 5 degrees) hold no rotation about them.
FLAT = 0.9962
#: Normals nearer than this are those of one plane.
SAME_PLANE = 1.0 - 1e-10
#: Lever arms below this share of the model's size hold nothing.
HELD = 1e-5
#: Digits that tell normals, levers and directions apart.
DIGITS = 9


@dataclass(frozen=True, slots=True)
class Brick:
    """One brick of a shell. lever: c, or None of a bending brick, whose levers are z.

    plane: (3, 3), shear: (2, 2), laws of the material; density: of volume, without WTMASS.
    """

    lever: float | None
    plane: Floats
    shear: Floats
    density: float


def bricks_of(shell: Shell, height: float, lumped: bool) -> list[Brick]:
    """The bricks that together have the stiffness and the mass of a shell."""
    law, none = shell.law, np.zeros((2, 2))
    density = 0.0 if lumped else law.mass / height
    middle, bending = law.offset, law.bending
    found = []
    if law.coupling.any():
        arm = law.thickness / 4.0
        half, more = law.membrane / 2.0, law.coupling / (2.0 * arm)
        found.append(Brick(middle + arm, (half + more) / height, none, density / 2.0))
        found.append(Brick(middle - arm, (half - more) / height, none, density / 2.0))
        bending = bending - arm**2 * law.membrane
    elif law.membrane.any() or density:
        found.append(Brick(middle, law.membrane / height, none, density))
    if law.bends or law.coupling.any():
        found.append(Brick(None, bending * 12.0 / height**3, law.shear / height, 0.0))
    return found


@dataclass(frozen=True, slots=True)
class WrittenShells:
    """What the laws of a model's shells became.

    laws: of each law that shells have a shell, the names of its bricks' materials, and what of it
    decides on more than their numbers.
    """

    height: float
    wtmass: float
    lumped: bool
    laws: dict[tuple[object, ...], tuple[Shell, tuple[str, ...], tuple[object, ...]]]


def write_shells(
    shells: Sequence[Shell],
    edges: Edges,
    builder: CalculixText,
    freedoms: Freedoms,
    wtmass: float,
    lumped: bool,
    sets_of: SetsOf,
    held: set[int],
) -> WrittenShells:
    """Add all shells of the model; after all else that is tied to their nodes.

    held: grid points that something besides shells holds.
    """
    if not shells:
        return WrittenShells(0.0, wtmass, lumped, {})
    turned = frozenset(freedoms.turn_nodes)
    writer = BrickWriter(builder, freedoms, HEIGHT * _usual_edge(shells, builder), wtmass)
    written = WrittenShells(writer.height, wtmass, lumped, {})
    for shell in shells:
        bricks = bricks_of(shell, writer.height, lumped)
        names = [writer.add(shell, brick, sets_of(shell.element)) for brick in bricks]
        element = shell.element
        key = (element.pid, own_thickness(element, []), element.tflag, element.zoffset)
        written.laws.setdefault(key, (shell, tuple(names), _shape(shell, bricks)))
    around: dict[int, list[Shell]] = {}
    for shell in shells:
        for node in shell.nodes:
            around.setdefault(node, []).append(shell)
    middles = {middle: edge for edge, middle in edges.middles.items() if middle in edges.made}
    for node, near in around.items():
        if any(shell.law.bends for shell in near):
            _hold_drilling(freedoms, node, near, node in turned)
        if node not in held and _is_flat(near):
            _hold_loose(freedoms, node, near, middles.get(node, ()))
    return written


def _usual_edge(shells: Sequence[Shell], builder: CalculixText) -> float:
    edges = [builder.coordinates[s.nodes[1]] - builder.coordinates[s.nodes[0]] for s in shells]
    return float(np.median(np.linalg.norm(edges, axis=1)))


class BrickWriter:
    """Adds bricks; those of one plane share nodes, those of one law and direction a section."""

    def __init__(
        self, builder: CalculixText, freedoms: Freedoms, height: float, wtmass: float
    ) -> None:
        self._builder = builder
        self._freedoms = freedoms
        self.height = height
        self._wtmass = wtmass
        self._nodes: dict[tuple[float | int | None, ...], int] = {}
        self._materials: dict[tuple[int, tuple[str, ...]], str] = {}
        self._sections: dict[tuple[str, tuple[float, ...]], str] = {}

    def add(self, shell: Shell, brick: Brick, sets: Sequence[str]) -> str:
        """Add one brick of a shell to these sets; returns the name of its material."""
        quad = len(shell.nodes) == 8
        corners, normal = 4 if quad else 3, np.round(shell.normal, DIGITS) + 0.0
        places = np.array([self._builder.coordinates[node] for node in shell.nodes])
        beside = (places - places[:corners].mean(axis=0)) @ shell.normal
        beside[np.abs(beside) < 1e-9 * self._builder.size] = 0.0
        low, high = -self.height / 2.0, self.height / 2.0
        rows = [(low, 0), (high, 0), (low, 1), (high, 1), (0.0, 0)]
        nodes = [
            self._node(shell.nodes[place], normal, float(-beside[place]), z, brick.lever)
            for z, middles in rows
            for place in range(middles * corners, (middles + 1) * corners)
        ]
        kind = "C3D20R" if quad else "C3D15"
        material = self._material(shell.element.pid, material_lines(brick, self._wtmass))
        section = self._section(material, shell.axis, normal)
        self._builder.new_element(kind, nodes, (*sets, section))
        return material

    def _node(self, node: int, normal: Floats, down: float, z: float, lever: float | None) -> int:
        """A brick's node at z over the mean plane, which is `down` from the shell's node."""
        arm = z if lever is None else round(down + lever, 12)
        key = (node, *normal.tolist(), round(down, 12), z, arm, lever is None)
        if key in self._nodes:
            return self._nodes[key]
        place = self._builder.coordinates[node] + (down + z + (lever or 0.0)) * normal
        made = self._nodes[key] = self._builder.new_node(place)
        x, y, z = normal.tolist()
        # Displacement along each basic axis: of theta x n it is theta . (n x axis).
        turning = ((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))
        freedoms = self._freedoms.translations(node)
        rotations = self._freedoms.rotations(node) if arm else []
        for axis, row in enumerate(turning):
            if lever is None:
                moves = [(x, y, z)[axis] * share for share in (x, y, z)]
            else:
                moves = [float(axis == other) for other in range(3)]
            shares = [*zip(freedoms, moves, strict=True)]
            shares += zip(rotations, (arm * share for share in row), strict=False)
            terms = [(n, c, -factor) for (n, c), factor in shares if abs(factor) > 1e-14]
            if terms:
                self._builder.equation([(made, axis + 1, 1.0), *terms])
            else:
                self._builder.fixed(made, axis + 1)
        return made

    def _material(self, pid: int, lines: tuple[str, ...]) -> str:
        """The name of a material; of each property its own, whose numbers may change."""
        key = (pid, lines)
        if key not in self._materials:
            self._materials[key] = f"L{len(self._materials) + 1}"
            self._builder.material(self._materials[key], lines)
        return self._materials[key]

    def _section(self, material: str, first: Floats, normal: Floats) -> str:
        axes = (*first, *np.cross(normal, first))
        key = (material, tuple(round(float(value), DIGITS) + 0.0 for value in axes))
        if key not in self._sections:
            name = self._sections[key] = f"S{len(self._sections) + 1}"
            head = f"*ORIENTATION, NAME=O{name}, SYSTEM=RECTANGULAR"
            self._builder.card([head, number_list(key[1])])
            self._builder.section(
                [f"*SOLID SECTION, ELSET={name}, MATERIAL={material}, ORIENTATION=O{name}"]
            )
        return self._sections[key]


def material_lines(brick: Brick, wtmass: float) -> tuple[str, ...]:
    """The cards of a brick's material."""
    plane, shear = brick.plane, brick.shear
    numbers = np.zeros(21)
    numbers[[0, 1, 2, 6, 7, 9]] = plane[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    numbers[[14, 19, 20]] = shear[[0, 0, 1], [0, 1, 1]]
    lines = ["*ELASTIC, TYPE=ANISO"]
    lines += [number_list(numbers[start : start + 8]) for start in (0, 8, 16)]
    if brick.density:
        lines += ["*DENSITY", number_list((brick.density * wtmass,))]
    return tuple(lines)


def edited_materials(written: WrittenShells, bulk: Any) -> dict[str, tuple[str, ...]] | None:
    """The cards of all materials of the shells, whose properties have other numbers now.

    None where more than these follow from the numbers: other bricks, or a law for some of those
    elements alone that had one in common.
    """
    found: dict[str, tuple[str, ...]] = {}
    owners: set[tuple[int, str]] = set()
    for shell, names, shape in written.laws.values():
        element = bulk.elements[shell.element.eid]
        try:
            law = law_of(element.pid_ref, own_thickness(element, []))
        except ValueError:
            return None
        now = replace(shell, law=replace(law, offset=shell.law.offset) if element.zoffset else law)
        bricks = bricks_of(now, written.height, written.lumped)
        if _shape(now, bricks) != shape:
            return None
        for name, brick in zip(names, bricks, strict=True):
            owners.add((element.pid, name))
            lines = material_lines(brick, written.wtmass)
            if found.setdefault(name, lines) != lines:
                return None
    # Two materials of a property that are one now would have one name.
    return found if len({(pid, found[name]) for pid, name in owners}) == len(owners) else None


def _shape(shell: Shell, bricks: Sequence[Brick]) -> tuple[object, ...]:
    """What of a shell's law decides on more than the numbers of materials."""
    levers = [(brick.lever, bool(brick.density)) for brick in bricks]
    return (shell.law.bends, shell.law.stretches, *levers)


def _hold_drilling(freedoms: Freedoms, node: int, near: Sequence[Shell], turned: bool) -> None:
    """Tie the rotation about the normal; turned: whether anything but shells has rotations here."""
    axis, rotations = near[0].normal, freedoms.rotations(node)
    own = freedoms.along(rotations, axis)
    if not _is_flat(near) or not _is_loose(freedoms, own) or _is_held(freedoms, node, axis):
        return
    same = all(abs(float(shell.normal @ axis)) > SAME_PLANE for shell in near)
    form: Form = {}
    if turned or not same:
        form = _mean_rotation(freedoms, node, axis, {n for s in near for n in s.nodes} - {node})
    freedoms.tie([difference(own, form)], rotations, f"rotation of {node} in its plane")


def _hold_loose(
    freedoms: Freedoms, node: int, near: Sequence[Shell], ends: tuple[int, ...]
) -> None:
    """Hold the directions in which shells of one plane have no stiffness, as AUTOSPC does.

    ends: the corners beside a midside node, which moves as their mean does there.
    """
    axes = [near[0].axis, np.cross(near[0].normal, near[0].axis)]
    axes = [] if any(shell.law.stretches for shell in near) else axes
    axes += [] if any(shell.law.bends for shell in near) else [near[0].normal]
    for axis in axes:
        own = freedoms.along(freedoms.translations(node), axis)
        if _is_loose(freedoms, own):
            mean = [freedoms.along(freedoms.translations(end), 0.5 * axis) for end in ends]
            form = difference(own, total(mean))
            freedoms.tie([form], list(own), f"displacement of {node} across its shells")


def _is_flat(near: Sequence[Shell]) -> bool:
    return all(abs(float(shell.normal @ near[0].normal)) > FLAT for shell in near)


def _is_loose(freedoms: Freedoms, form: Form) -> bool:
    """Whether some freedom of the form is neither fixed nor dependent."""
    return any(not freedoms.is_dependent(f) and not freedoms.builder.is_fixed(*f) for f in form)


def _is_held(freedoms: Freedoms, node: int, axis: Floats) -> bool:
    found = np.abs(freedoms.holds(node) @ axis)
    return bool((found > HELD * freedoms.builder.size).any())


def _mean_rotation(freedoms: Freedoms, node: int, normal: Floats, near: set[int]) -> Form:
    """The rotation about the normal that fits the displacements of the nodes near best."""
    others = sorted(near)
    places = freedoms.builder.coordinates
    arms = np.array([places[other] - places[node] for other in others])
    spread = np.trace(arms.T @ arms) * np.eye(3) - arms.T @ arms
    factors = np.cross(np.linalg.solve(spread, normal), arms)
    form: Form = {}
    for other, (x, y, z) in zip(others, factors.tolist(), strict=True):
        pairs = (*freedoms.translations(other), *freedoms.translations(node))
        for freedom, factor in zip(pairs, (x, y, z, -x, -y, -z), strict=True):
            form[freedom] = form.get(freedom, 0.0) + factor
    return trimmed(form)


def hold_leaders(freedoms: Freedoms, leaders: set[int]) -> None:
    """Fix what no element hinders of the rotations of rigid elements' independent points.

    As AUTOSPC does; leaders: those without shells and without beams or springs on rotations.
    """
    for node in leaders:
        rotations = freedoms.rotations(node)
        if all(freedoms.is_dependent(f) or freedoms.builder.is_fixed(*f) for f in rotations):
            continue
        holds = freedoms.holds(node)
        _, sizes, axes = np.linalg.svd(np.vstack([holds, np.zeros((3, 3))]))
        free = axes[sizes < HELD * freedoms.builder.size]
        rows = [freedoms.along(rotations, axis) for axis in free]
        freedoms.tie(rows, rotations, f"rotation of {node}")
