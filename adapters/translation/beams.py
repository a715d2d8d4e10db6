"""Nastran bars, beams and rods in CalculiX, exact for any cross-section.

ccx expands its beams to solids of a few cross-sections, and its user element U1 has no mass in a
frequency step. So a beam is given by its strain energy: six springs on linear forms of the grid
points' freedoms (`beam_theory`); offsets and released ends are part of the forms.

The mass is one C3D8 of no stiffness. Its eight integration points are two Gauss stations along the
beam times the radii of gyration across it, and they move as the beam's own cubic shape does: the
corners are tied to the straight line through the two stations. Mass, centre and inertia are exact,
rotary inertia included.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from modetune.adapters.translation.beam_theory import (
    Beam,
    cross_matrix,
    deformations,
    station,
    stiffnesses,
)
from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.cross_sections import CrossSection, cross_section
from modetune.adapters.translation.freedoms import Form, Freedoms, difference, trimmed
from modetune.adapters.translation.shells import SetsOf
from modetune.adapters.translation.springs import GroundedSprings
from modetune.core.modes import Floats

BEAMS = ("CBAR", "CBEAM")
RODS = ("CROD", "CONROD", "CTUBE")
KINDS = (*BEAMS, *RODS)
#: Stiffness of the mass carriers as a share of the beam's own E: nothing in double precision.
NO_STIFFNESS = 1e-14
#: Share of its radius of gyration with which a CBAR's mass resists twisting: Nastran gives it no
#: torsional inertia (but for MDLPRM,BARMASS), and a free bar must have some to spin with.
BAR_TORSION = 0.01
#: Corners of a C3D8 in its own order, in units of half its sides.
CORNERS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1],
     [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=np.float64,
)  # fmt: skip


def translate_beams(
    bulk: Any,
    builder: CalculixText,
    freedoms: Freedoms,
    problems: list[str],
    wtmass: float,
    sets_of: SetsOf,
) -> None:
    """Add all bars, beams and rods; after the constraints, which say what is fixed."""
    springs = GroundedSprings(builder, freedoms)
    for element in bulk.elements.values():
        if element.type not in KINDS:
            continue
        try:
            beam = _beam(element, freedoms)
        except ValueError as reason:
            problems.append(f"{element.type} {element.eid}: {reason}")
            continue
        sets = sets_of(element)
        forms = [
            (_form(row, beam, freedoms), stiffness)
            for row, stiffness in zip(
                deformations(beam) @ beam.motion, stiffnesses(beam), strict=True
            )
        ]
        springs.add(forms, sets)
        _add_mass(beam, builder, freedoms, wtmass, sets)


def _beam(element: Any, freedoms: Freedoms) -> Beam:
    """Raises ValueError with what cannot be translated."""
    is_rod = element.type in RODS
    card = element if element.type == "CONROD" else element.pid_ref
    section = cross_section(card)
    first, second = element.node_ids
    places = [freedoms.builder.coordinates[node] for node in (first, second)]
    offsets = np.zeros((2, 3)) if is_rod else _offsets(element, freedoms)
    ends = np.array(places) + offsets
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if not length > 0.0:
        raise ValueError("its ends coincide")
    axes = _axes(element, ends, places[0], is_rod, freedoms)
    section, axes = _principal(section, axes)
    turn = np.kron(np.eye(4), axes)
    turn[:3, 3:6] = axes @ cross_matrix(offsets[0])
    turn[6:9, 9:12] = axes @ cross_matrix(offsets[1])
    share = BAR_TORSION if element.type == "CBAR" else 1.0
    beam = Beam(element.eid, (first, second), section, ends, axes, turn, share)
    return beam if is_rod else _released(beam, element)


def _offsets(element: Any, freedoms: Freedoms) -> Floats:
    """(2, 3), from the grid points to the beam's ends, basic coordinates."""
    given = [element.wa, element.wb]
    if not np.any(given):
        return np.zeros((2, 3))
    kind = getattr(element, "offt", "GGG")
    if kind != "GGG":
        raise ValueError(f"offsets with OFFT={kind}, only GGG is translated")
    return np.array(
        [
            np.asarray(offset) @ freedoms.frames.get(node, np.eye(3))
            for offset, node in zip(given, element.node_ids, strict=True)
        ]
    )


def _axes(element: Any, ends: Floats, place: Floats, is_rod: bool, freedoms: Freedoms) -> Floats:
    x = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    if is_rod:
        guess = np.eye(3)[int(np.argmin(np.abs(x)))]
    else:
        if not str(getattr(element, "offt", None) or "GGG").startswith("G"):
            raise ValueError(f"an orientation vector with OFFT={element.offt}")
        guess = _orientation(element, place, freedoms)
    z = np.cross(x, guess)
    size = float(np.linalg.norm(z))
    if not size > 1e-6 * float(np.linalg.norm(guess)):
        raise ValueError("its orientation vector is along its axis")
    z = z / size
    return np.array([x, np.cross(z, x), z])


def _orientation(element: Any, place: Floats, freedoms: Freedoms) -> Floats:
    if element.g0:
        return np.asarray(freedoms.builder.coordinates[element.g0] - place)
    if element.x is None or any(value is None for value in element.x):
        raise ValueError("it has no orientation vector")
    frame = freedoms.frames.get(element.node_ids[0], np.eye(3))
    return np.asarray(np.asarray(element.x, dtype=np.float64) @ frame)


def _principal(section: CrossSection, axes: Floats) -> tuple[CrossSection, Floats]:
    """The section in its principal axes."""
    cross = section.inertia_12
    if abs(cross) <= 1e-9 * max(section.inertia_1, section.inertia_2):
        return section, axes
    if section.shear_1 != section.shear_2:
        raise ValueError("I12 together with shear factors K1 and K2 that differ")
    # [[I1, I12], [I12, I2]] is the tensor of second moments of (y, z).
    moments, vectors = np.linalg.eigh([[section.inertia_1, cross], [cross, section.inertia_2]])
    if moments[0] < 0.0:
        raise ValueError(f"I12={cross:g} is more than I1 and I2 allow")
    y = vectors[:, 1] @ axes[1:]
    z = np.cross(axes[0], y)
    turned = replace(
        section, inertia_1=float(moments[1]), inertia_2=float(moments[0]), inertia_12=0.0
    )
    return turned, np.array([axes[0], y, z])


def _released(beam: Beam, element: Any) -> Beam:
    """Pin flags: the freedoms between beam and grid point go where no force acts on them."""
    flags = [(getattr(element, name) or 0, base) for name, base in (("pa", 0), ("pb", 6))]
    free = [base + int(digit) - 1 for flag, base in flags for digit in str(flag) if digit != "0"]
    for name in ("sa", "sb"):
        if getattr(element, name, 0):
            raise ValueError("warping points (SA, SB)")
    if not free:
        return beam
    rows = deformations(beam)
    stiffness = rows.T @ (stiffnesses(beam)[:, None] * rows)
    kept = [place for place in range(12) if place not in free]
    condensed = np.eye(12)
    inner = stiffness[np.ix_(free, free)]
    scale = np.sqrt(np.where(inner.diagonal() > 0.0, inner.diagonal(), 1.0))
    scaled = inner / np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e10:
        raise ValueError("its pin flags leave it a mechanism")
    condensed[free] = 0.0
    condensed[np.ix_(free, kept)] = -np.linalg.solve(inner, stiffness[np.ix_(free, kept)])
    return replace(beam, motion=condensed @ beam.motion)


def _form(row: Floats, beam: Beam, freedoms: Freedoms) -> Form:
    """A linear form of the grid points' 12 basic freedoms (a row of factors)."""
    form: Form = {}
    largest = np.abs(row).max()
    for place, node in enumerate(beam.nodes):
        for three, factors in enumerate(row[6 * place : 6 * place + 6].reshape(2, 3)):
            if np.abs(factors).max() <= 1e-12 * largest:
                continue
            names = freedoms.rotations(node) if three else freedoms.translations(node)
            for freedom, factor in zip(names, factors, strict=bool(names)):
                form[freedom] = form.get(freedom, 0.0) + float(factor)
    return trimmed(form)


def _add_mass(
    beam: Beam,
    builder: CalculixText,
    freedoms: Freedoms,
    wtmass: float,
    sets: Any,
) -> None:
    section, length = beam.section, beam.length
    mass = section.mass_per_length
    if not mass:
        return
    inertia = (section.inertia_1, section.inertia_2)
    radii = np.sqrt([section.density * value / mass for value in inertia])
    # Sides of a uniform box with these radii of gyration; a box needs some extent all the same.
    sides = np.maximum(math.sqrt(12.0) * radii, 1e-3 * length)
    gauss = math.sqrt(1.0 / 3.0)
    near, far = (station(beam, 0.5 * (1.0 + sign * gauss)) @ beam.motion for sign in (-1.0, 1.0))
    middle, slope = 0.5 * (near + far), 0.5 * (far - near) / gauss
    nodes = []
    for along, *across in CORNERS:
        arm = 0.5 * np.array(across) * sides
        place = beam.ends.mean(axis=0) + 0.5 * along * length * beam.axes[0] + arm @ beam.axes[1:]
        node = builder.new_node(place)
        motion = middle + along * slope
        lever = 0.5 * math.sqrt(12.0) * radii * np.array(across)
        turning = motion[3:].copy()
        turning[0] *= beam.torsional_share
        moved = motion[:3] + cross_matrix(np.array([0.0, *lever])) @ turning
        for component, row in enumerate(beam.axes.T @ moved, start=1):
            own = (node, component)
            form = difference({own: 1.0}, _form(row, beam, freedoms))
            freedoms.tie([form], [own], f"node {node}")
        nodes.append(node)
    density = mass * wtmass / float(np.prod(sides))
    name = _mass_material(builder, density, section.youngs_modulus)
    builder.new_element("C3D8", nodes, (name, *sets))


def _mass_material(builder: CalculixText, density: float, youngs_modulus: float) -> str:
    """The material and section (of one name) of mass carriers of this density."""
    lines = [
        "*ELASTIC",
        number_list((NO_STIFFNESS * youngs_modulus, 0.0)),
        "*DENSITY",
        number_list((density,)),
    ]
    count = 1
    while not builder.can_be_material(f"MASS_{count}", lines):
        count += 1
    name = f"MASS_{count}"
    if name not in builder.sets:
        builder.material(name, lines)
        builder.section([f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"])
    return name
