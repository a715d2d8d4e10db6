"""Nastran bars, beams and rods in CalculiX, exact for any cross-section.

ccx expands its beams to solids of a few cross-sections, and its user element U1 has no mass in a
frequency step. So a beam is given by its strain energy: six springs on linear forms of the grid
points' freedoms (`beam_theory`); offsets and released ends are part of the forms.

The mass between two stations is one C3D8 of no stiffness. Its eight integration points are two
Gauss stations along the beam times the radii of gyration across it, and they move as the beam's own
shape does: the corners are tied to the straight line through the two stations. Mass, centre and
inertia are exact, rotary inertia included; the width varies as the mass along the beam does. Where
the deck lumps masses one C3D8, whose Gauss stations are the ends, has each end's share there: with
the torsional inertia of a CBEAM and none about the other axes, as Nastran lumps it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modetune.adapters.nastran.cross_sections import check_warping, cross_section
from modetune.adapters.nastran.element_axes import beam_axes
from modetune.adapters.translation.assembly import Assembly
from modetune.adapters.translation.beam_theory import Beam, cross_matrix
from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.freedoms import Form, Freedoms, difference, trimmed
from modetune.adapters.translation.springs import GroundedSprings
from modetune.core.modes import Floats

BEAMS = ("CBAR", "CBEAM")
RODS = ("CROD", "CONROD", "CTUBE")
KINDS = (*BEAMS, *RODS)
#: Stiffness of the mass carriers as a share of the beam's own E: nothing in double precision, and
#: so little that carriers which do not move as their own shape would leave rigid modes rigid.
NO_STIFFNESS = 1e-24
#: Share of its radius of gyration with which a CBAR's mass resists twisting: Nastran gives it no
#: torsional inertia (but for MDLPRM,BARMASS), and a free bar must have some to spin with.
BAR_TORSION = 0.01
#: Corners of a C3D8 in its own order, in units of half its sides.
CORNERS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1],
     [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], dtype=np.float64,
)  # fmt: skip
#: Where the two Gauss stations of a C3D8 are, in units of half its length.
GAUSS = math.sqrt(1.0 / 3.0)
#: Largest change of its width to an end: a beam whose mass ends in a point keeps a face there.
SLOPE = 0.999


def translate_beams(model: Assembly) -> None:
    """Add all bars, beams and rods; after the constraints, which say what is fixed."""
    freedoms = model.freedoms
    springs = GroundedSprings(freedoms)
    for element in model.elements(*KINDS):
        try:
            beam = beam_of(element, freedoms)
            forms, stiffnesses = beam.springs
        except (ValueError, np.linalg.LinAlgError) as error:
            impossible = isinstance(error, np.linalg.LinAlgError)
            reason = "I12 is more than I1 and I2 allow" if impossible else error
            model.refuse(element, reason)
            continue
        sets = model.sets_of(element)
        springs.add(
            [
                (_form(row, beam, freedoms), stiffness)
                for row, stiffness in zip(forms @ beam.motion, stiffnesses, strict=True)
            ],
            sets,
        )
        for carrier in _carriers(beam, model.lumped):
            _add_mass(model, beam, carrier, sets)


def beam_of(element: Any, freedoms: Freedoms) -> Beam:
    """A bar, beam or rod. Raises ValueError with what cannot be translated."""
    is_rod = element.type in RODS
    section = cross_section(element if element.type == "CONROD" else element.pid_ref)
    where = beam_axes(element, freedoms.builder.coordinates, freedoms.frames)
    turn = np.kron(np.eye(4), where.axes)
    turn[:3, 3:6] = where.axes @ cross_matrix(where.offsets[0])
    turn[6:9, 9:12] = where.axes @ cross_matrix(where.offsets[1])
    share = BAR_TORSION if element.type == "CBAR" else 1.0
    first, second = element.node_ids
    beam = Beam(element.eid, (first, second), section, where.ends, where.axes, turn, turn, share)
    return beam if is_rod else _released(beam, element)


def _released(beam: Beam, element: Any) -> Beam:
    """Pin flags: the freedoms between beam and grid point go where no force acts on them."""
    check_warping(element)
    flags = [(getattr(element, name) or 0, base) for name, base in (("pa", 0), ("pb", 6))]
    free = [base + int(digit) - 1 for flag, base in flags for digit in str(flag) if digit != "0"]
    stiffness = beam.deformations.T @ beam.stiffness @ beam.deformations
    free = [place for place in free if stiffness[place, place] > 0.0]  # without I1 no hinge for it
    if not free:
        return beam
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


@dataclass(frozen=True, slots=True)
class Carrier:
    """A box whose mass moves as two stations of a beam do, where its Gauss points are.

    stretch: where it begins and ends, 0..1 of the beam's length; mass: mean, per length; slope: its
    change to an end, as a share; centres: (2,) at both ends. Of each station its shape (6, 12) and
    its mass, centre and second moments; turning: (3,), share of the levers that turns with it.
    """

    stretch: tuple[float, float]
    mass: float
    slope: float
    centres: tuple[Floats, Floats]
    shapes: tuple[Floats, Floats]
    stations: tuple[tuple[float, Floats, Floats], ...]
    turning: Floats


def _carriers(beam: Beam, lumped: bool) -> Iterator[Carrier]:
    """Of the whole beam, or between two places where its mass changes linearly.

    Lumped masses are those of the ends, which twist and do not turn otherwise.
    """
    section, turning = beam.section, np.array([beam.torsional_share, 1.0, 1.0])
    for start, stop in [(0.0, 1.0)] if lumped else section.stretches:
        ends = [section.mass(place) for place in (start, stop)]
        mean, slope = 0.5 * (ends[0][0] + ends[1][0]), 0.0
        gauss = [0.5 * (start + stop) + 0.5 * sign * GAUSS * (stop - start) for sign in (-1.0, 1.0)]
        stations = tuple(section.mass(place) for place in gauss)
        centres = ends[0][1], ends[1][1]
        if lumped:
            near, far = section.end_masses
            if near + far:
                slope = (far - near) / (near + far) / GAUSS
            beyond = (1.0 - GAUSS) / (2.0 * GAUSS)  # the Gauss points are at the ends then
            apart = beyond * (centres[1] - centres[0])
            yield Carrier(
                (-beyond, 1.0 + beyond),
                GAUSS * (near + far),
                slope,
                (centres[0] - apart, centres[1] + apart),
                (beam.carried[:6], beam.carried[6:]),
                stations,
                turning * [1.0, 0.0, 0.0],
            )
            continue
        if mean:
            slope = 0.5 * (ends[1][0] - ends[0][0]) / mean
        near_shape, far_shape = (beam.station(place) @ beam.motion for place in gauss)
        shapes = near_shape, far_shape
        yield Carrier((start, stop), mean, slope, centres, shapes, stations, turning)


def _add_mass(model: Assembly, beam: Beam, carrier: Carrier, sets: Sequence[str]) -> None:
    """Add a carrier, if there is anything to carry."""
    if not carrier.mass:
        return
    start, stop = carrier.stretch
    # Roots of the second moments: levers at which four masses have these.
    levers = [_root(second / own) for own, _, second in carrier.stations]
    radii = np.sqrt(np.mean([(lever @ lever).diagonal() for lever in levers], axis=0))
    # Sides of a uniform box with these radii of gyration; a box needs some extent all the same.
    sides = np.maximum(math.sqrt(12.0) * radii, 1e-3 * (stop - start) * beam.length)
    slope = np.clip(carrier.slope, -SLOPE, SLOPE)
    nodes = []
    for along, *across in CORNERS:
        arm = 0.5 * np.array(across) * sides * [1.0, 1.0 + along * slope]
        end = int(along > 0.0)
        place = beam.place(carrier.stretch[end], carrier.centres[end] + arm)
        node = model.builder.new_node(place)
        near, far = (
            _moved(shape, centre, lever @ across, carrier.turning)
            for shape, (_, centre, _), lever in zip(
                carrier.shapes, carrier.stations, levers, strict=True
            )
        )
        moved = 0.5 * (near + far) + 0.5 * along / GAUSS * (far - near)
        for component, row in enumerate(beam.axes.T @ moved, start=1):
            own = (node, component)
            form = difference({own: 1.0}, _form(row, beam, model.freedoms))
            model.freedoms.tie([form], [own], f"node {node}")
        nodes.append(node)
    density = carrier.mass * model.wtmass / float(np.prod(sides))
    name = _mass_material(model.builder, density, beam.section.youngs_modulus)
    model.builder.new_element("C3D8", nodes, (name, *sets))


def _moved(station: Floats, centre: Floats, lever: Floats, turning: Floats) -> Floats:
    """(3, n), displacement of a place beside the shear centre; centre, lever: (2,), y and z.

    The lever is a radius of gyration at the integration points, which turns by shares (3,) alone.
    """
    corner = lever / GAUSS
    return np.asarray(
        station[:3]
        + cross_matrix(np.array([0.0, *centre])) @ station[3:]
        + cross_matrix(np.array([0.0, *corner])) @ (turning[:, None] * station[3:])
    )


def _root(second: Floats) -> Floats:
    """The symmetric square root of a positive semi-definite (2, 2) matrix."""
    middle = math.sqrt(max(second[0, 0] * second[1, 1] - second[0, 1] ** 2, 0.0))
    size = math.sqrt(second[0, 0] + second[1, 1] + 2.0 * middle)
    return (second + middle * np.eye(2)) / size if size else np.zeros((2, 2))


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
