"""The bricks that have a shell's stiffness and mass, and what of them follows from its law."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modetune.adapters.nastran.lumped_masses import LumpedElement, mass_of
from modetune.adapters.nastran.shell_laws import law_of
from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.masses import Shares, group_lines
from modetune.adapters.translation.shells import Shell, own_thickness
from modetune.core.modes import Floats


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


def law_key(element: Any) -> Hashable:
    """What tells the laws of shells apart, as the source of a density too."""
    return (element.pid, own_thickness(element, []), element.tflag, element.zoffset)


def shell_densities(shells: Sequence[Shell]) -> dict[Hashable, float]:
    """Mass of a unit of area by law, without WTMASS."""
    return {law_key(shell.element): shell.law.mass for shell in shells}


def lumped_shells(
    shells: Sequence[Shell], builder: CalculixText, properties: frozenset[int]
) -> list[LumpedElement]:
    """Shells of these properties, whose masses are lumped."""
    found = []
    for shell in shells:
        if shell.element.pid in properties:
            nodes = shell.nodes[: len(shell.nodes) // 2]
            corners = np.array([builder.coordinates[node] for node in nodes])
            kind = "S4" if len(nodes) == 4 else "S3"
            offset = shell.law.offset * shell.normal
            found.append(LumpedElement(law_key(shell.element), kind, nodes, corners, offset))
    return found


@dataclass(frozen=True, slots=True)
class WrittenShells:
    """What the laws of a model's shells became.

    laws: of each law that shells have a shell, the names of its bricks' materials, and what of it
    decides on more than their numbers. lumped: properties whose masses are in groups, by the
    densities of their sources.
    """

    height: float
    size: float
    wtmass: float
    lumped: frozenset[int]
    laws: dict[Hashable, tuple[Shell, tuple[str, ...], tuple[object, ...]]]
    groups: dict[str, Shares]
    densities: dict[Hashable, float]

    def edited(self, bulk: Any) -> dict[str, tuple[str, ...]] | None:
        """The numbers of all materials and masses of the shells, by their names.

        bulk: the model whose properties have other numbers now. None where more than these follow
        from the numbers: other bricks, or a law for some of those elements alone that had one in
        common.
        """
        found: dict[str, tuple[str, ...]] = {}
        owners: set[tuple[int, str]] = set()
        densities = dict(self.densities)
        for key, (shell, names, shape) in self.laws.items():
            element = bulk.elements[shell.element.eid]
            try:
                law = law_of(element.pid_ref, own_thickness(element, []))
            except ValueError:
                return None
            law = replace(law, offset=shell.law.offset) if element.zoffset else law
            now = replace(shell, law=law)
            bricks = bricks_of(now, self.height, element.pid in self.lumped)
            if shape_of(now, bricks) != shape:
                return None
            densities[key] = law.mass
            for name, brick in zip(names, bricks, strict=True):
                owners.add((element.pid, name))
                lines = material_lines(brick, self.wtmass)
                if found.setdefault(name, lines) != lines:
                    return None
        # Two materials of a property that are one now would have one name.
        if len({(pid, found[name]) for pid, name in owners}) != len(owners):
            return None
        for name, shares in self.groups.items():
            found |= group_lines(name, mass_of(shares, densities) * self.wtmass, self.size)
        return found


def shape_of(shell: Shell, bricks: Sequence[Brick]) -> tuple[object, ...]:
    """What of a shell's law decides on more than the numbers of materials and masses."""
    levers = [(brick.lever, bool(brick.density)) for brick in bricks]
    return (shell.law.bends, shell.law.stretches, shell.law.offset, bool(shell.law.mass), *levers)
