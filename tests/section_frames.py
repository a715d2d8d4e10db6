"""Frames of straight members, assembled by numpy: their matrices at any section.

A member has a length, two nodes of three local motions each (along, across, rotation) and the rows
that take global unknowns to these. Stiffness is E A times an axial part plus E I times a bending
part, mass rho A times a consistent part (Przemieniecki 1968, chapters 5 and 11).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.linalg import eigh

from modetune.core.modes import Floats

E, RHO = 7e10, 2700.0


@dataclass(frozen=True)
class Frame:
    """A frame of one section.

    axial, bending, mass: (n, n), of unit E A, unit E I and unit rho A; lumps: (n, n), masses that
    belong to no section; dofs: (node, component) of the unknowns.
    """

    axial: Floats
    bending: Floats
    mass: Floats
    lumps: Floats
    dofs: list[tuple[int, int]]

    def at(self, area: float, inertia: float) -> tuple[Floats, Floats]:
        return E * (area * self.axial + inertia * self.bending), RHO * area * self.mass + self.lumps

    def hz(self, area: float, inertia: float, n: int) -> Floats:
        stiffness, mass = self.at(area, inertia)
        return np.asarray(np.sqrt(eigh(stiffness, mass, eigvals_only=True)[:n]) / 2 / np.pi)

    def write(self, folder: Path, area: float, inertia: float) -> Path:
        """Write a model of matrices with the parts axial, bending and section (mass)."""
        stiffness, mass = self.at(area, inertia)
        parts = {
            "K": stiffness,
            "M": mass,
            "axial": E * area * self.axial,
            "bending": E * inertia * self.bending,
            "section": RHO * area * self.mass,
        }
        for name, matrix in parts.items():
            sparse.save_npz(folder / f"{name}.npz", sparse.csr_array(matrix))
        (folder / "dofs.txt").write_text("".join(f"{n}.{c}\n" for n, c in self.dofs))
        path = folder / "frame.yaml"
        path.write_text(
            "stiffness: K.npz\nmass: M.npz\ndofs: dofs.txt\nparts:\n"
            "  axial: {stiffness: axial.npz}\n  bending: {stiffness: bending.npz}\n"
            "  section: {mass: section.npz}\n"
        )
        return path


def assembled(dofs: list[tuple[int, int]], members: list[tuple[int, int, float, Floats]]) -> Frame:
    """members: two nodes, the length, and local motions of a node in its six components, (3, 6)."""
    place = {dof: row for row, dof in enumerate(dofs)}
    found = np.zeros((3, len(dofs), len(dofs)))
    for first, second, length, local in members:
        rows = np.zeros((6, len(dofs)))
        for end, node in enumerate((first, second)):
            for component in range(1, 7):
                if (node, component) in place:
                    motion = local[:, component - 1]
                    rows[3 * end : 3 * end + 3, place[(node, component)]] = motion
        for total, own in zip(found, member(length), strict=True):
            total += rows.T @ own @ rows
    return Frame(found[0], found[1], found[2], np.zeros_like(found[0]), dofs)


def member(length: float) -> tuple[Floats, Floats, Floats]:
    axial, bending, mass = np.zeros((3, 6, 6))
    along, across = [0, 3], [1, 2, 4, 5]
    axial[np.ix_(along, along)] = np.array([[1, -1], [-1, 1]]) / length
    scale = np.diag([1.0, length, 1.0, length])
    shape = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])
    bending[np.ix_(across, across)] = scale @ shape @ scale / length**3
    mass[np.ix_(along, along)] = length / 6 * np.array([[2, 1], [1, 2]])
    inertia = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]])
    mass[np.ix_(across, across)] = length / 420 * scale @ inertia @ scale
    return axial, bending, mass


def in_plane(points: Floats, links: list[tuple[int, int]], held: set[tuple[int, int]]) -> Frame:
    """A frame in the plane x, y with rotations about z; points: (n, 2) of the nodes 1 to n."""
    members = []
    for first, second in links:
        run = points[second - 1] - points[first - 1]
        length = float(np.hypot(*run))
        cos, sin = run / length
        local = np.array([[cos, sin, 0, 0, 0, 0], [-sin, cos, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1]])
        members.append((first, second, length, local))
    numbers = range(1, len(points) + 1)
    dofs = [(n, c) for n in numbers for c in (1, 2, 6) if (n, c) not in held]
    return assembled(dofs, members)


def portal() -> Frame:
    """Two unequal legs and a beam between them, of one tube; both feet clamped."""
    legs = [[0.0, 0.0], [0.0, 0.4], [0.1, 0.8], [0.5, 0.8], [0.9, 0.7], [1.0, 0.3], [1.0, -0.1]]
    held = {(n, c) for n in (1, 7) for c in (1, 2, 6)}
    return in_plane(np.array(legs), [(n, n + 1) for n in range(1, 7)], held)


def arch() -> Frame:
    """A shallow arch on two hinges, where stretching and bending act together, with a mass of 2 kg
    on its crown."""
    angles = np.linspace(np.radians(145.0), np.radians(35.0), 11)
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    held = {(n, c) for n in (1, 11) for c in (1, 2)}
    frame = in_plane(points, [(n, n + 1) for n in range(1, 11)], held)
    crown = np.array([2.0 * (node == 6 and c < 3) for node, c in frame.dofs])
    return replace(frame, lumps=np.diag(crown))


def grid() -> Frame:
    """A plate-like grid of flat strips in the plane x, y: it stretches in it and bends out of it.

    Its corners are constrained in all translations.
    """
    n, step = 4, (0.30, 0.22)
    members = []
    for row in range(n):
        for column in range(n):
            here = row * n + column + 1
            if column + 1 < n:  # along x: rotation -ry
                members.append((here, here + 1, step[0], np.eye(6)[[0, 2, 4]] * [[1], [1], [-1]]))
            if row + 1 < n:  # along y: rotation rx
                members.append((here, here + n, step[1], np.eye(6)[[1, 2, 3]]))
            if column + 1 < n and row + 1 < n:  # a diagonal against shear
                length = float(np.hypot(*step))
                cos, sin = step[0] / length, step[1] / length
                local = np.zeros((3, 6))
                local[0, :2], local[1, 2], local[2, 3:5] = (cos, sin), 1.0, (sin, -cos)
                members.append((here, here + n + 1, length, local))
    corners = (1, n, n * n - n + 1, n * n)
    dofs = [
        (node, c) for node in range(1, n * n + 1) for c in (1, 2, 3, 4, 5)
        if not (node in corners and c < 4)
    ]  # fmt: skip
    return assembled(dofs, members)
