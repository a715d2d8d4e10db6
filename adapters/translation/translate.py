"""Nastran bulk data as the model part of a CalculiX deck, or a refusal that names every obstacle.

The grid points keep their numbers; what a card needs besides (midside nodes, rotations, the pieces
of a rigid mass) gets nodes beyond them. Every property has an element set `P<pid>`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.translation.beams import translate_beams
from modetune.adapters.translation.calculix_text import CalculixText
from modetune.adapters.translation.cards import refused_cards, summarised
from modetune.adapters.translation.freedoms import Freedoms
from modetune.adapters.translation.mass_properties import (
    MassProperties,
    calculix_mass_properties,
    check_masses,
)
from modetune.adapters.translation.masses import (
    point_masses,
    translate_masses,
    translate_scalar_masses,
)
from modetune.adapters.translation.nastran_masses import nastran_mass_properties
from modetune.adapters.translation.rigid import (
    leaders,
    translate_mpcs,
    translate_rigid_elements,
    translate_spcs,
)
from modetune.adapters.translation.shear_panels import translate_shear_panels
from modetune.adapters.translation.shell_bricks import WrittenShells, hold_leaders, write_shells
from modetune.adapters.translation.shells import KINDS as SHELLS
from modetune.adapters.translation.shells import understand_shells
from modetune.adapters.translation.solids import KINDS as SOLIDS
from modetune.adapters.translation.solids import translate_solids
from modetune.adapters.translation.springs import translate_springs
from modetune.adapters.translation.stiffness_matrices import matrix_components, translate_matrices
from modetune.core.errors import ModelError
from modetune.core.modes import Floats


@dataclass(frozen=True, slots=True)
class Translation:
    """A CalculiX model part and what is needed to read its results as the Nastran model's.

    text: *NODE to *BOUNDARY, no step. frames: grid point to (3, 3), basic-to-CD rotation, of those
    whose output frame is not the basic one. sets: names of all element sets of structural
    elements. grids: the bulk data's grid points, ascending. mass: mass properties that the cards
    say, WTMASS in them; mass_check: a sentence on how the translated ones agree, empty where
    nobody looked. shells: what becomes of their laws.
    """

    text: str
    frames: dict[int, Floats]
    sets: tuple[str, ...]
    grids: tuple[int, ...]
    mass: MassProperties
    mass_check: str
    shells: WrittenShells


def translate(
    bulk: Any,
    name: str,
    single: frozenset[int] = frozenset(),
    spc: int = 0,
    mpc: int = 0,
    k2gg: str = "",
    wtmass: float = 1.0,
    weighed: bool = True,
) -> Translation:
    """Translate a cross-referenced pyNastran BDF.

    name: of the deck, for messages. single: elements that get a set `E<eid>` of their own. spc,
    mpc: constraint sets, 0 for none. k2gg: the DMIG added to the stiffness, if any. wtmass:
    the factor on all masses, PARAM,WTMASS. weighed: whether the masses are held against the cards'.
    Raises ModelError with every card and feature that cannot be translated.
    """
    if not bulk.nodes and not bulk.spoints:
        raise ModelError(f"{name} has no GRID and no SPOINT, so there is nothing to translate")
    problems = refused_cards(bulk)
    builder = _builder(bulk)

    def sets_of(element: Any) -> Sequence[str]:
        names = [f"P{element.pid}"] if getattr(element, "pid", None) else []
        return (*names, f"E{element.eid}") if element.eid in single else names

    shells, edges = understand_shells(bulk, builder, problems)
    translate_solids(bulk, builder, problems, wtmass, sets_of)
    held = _held_rotations(bulk)
    bending = {node for shell in shells if shell.law.bends for node in shell.nodes}
    freedoms = _freedoms(bulk, builder, bending, held, problems)
    translate_spcs(bulk, freedoms, edges, spc, problems)
    translate_mpcs(bulk, freedoms, mpc, problems)
    translate_rigid_elements(bulk, freedoms, edges, problems)
    translate_beams(bulk, builder, freedoms, problems, wtmass, sets_of)
    translate_springs(bulk, builder, freedoms, problems, wtmass, sets_of)
    translate_matrices(bulk, builder, freedoms, problems, k2gg, sets_of)
    translate_shear_panels(bulk, builder, freedoms, problems, sets_of)
    masses = point_masses(bulk, problems)
    translate_masses(bulk, masses, builder, freedoms, wtmass, sets_of)
    translate_scalar_masses(bulk, builder, freedoms, problems, wtmass, sets_of)
    written = write_shells(shells, edges, builder, freedoms, wtmass, False, sets_of, _held(bulk))
    hold_leaders(freedoms, leaders(bulk) - held - freedoms.turning)
    if problems:
        found = "\n".join(f"- {problem}" for problem in summarised(problems))
        raise ModelError(f"{name} cannot be translated to CalculiX:\n{found}")
    text = builder.text()
    expected, check = nastran_mass_properties(bulk, shells, masses, freedoms, wtmass), ""
    if weighed:
        check = check_masses(expected, calculix_mass_properties(builder, text), builder.size)
    frames = {number: frame for number, frame in freedoms.frames.items() if number in bulk.nodes}
    sets = tuple(name for name in builder.sets if re.fullmatch(r"[PE]\d+", name))
    grids = tuple(sorted(bulk.nodes))
    return Translation(text, frames, sets, grids, expected, check, written)


def _builder(bulk: Any) -> CalculixText:
    """A builder with all grid points."""
    builder = CalculixText()
    for number in sorted(bulk.nodes):
        builder.node(number, np.asarray(bulk.nodes[number].get_position(), dtype=np.float64))
    place = next(iter(builder.coordinates.values()), np.zeros(3))
    for number in sorted(bulk.spoints):
        builder.node(number, place)
        for component in (2, 3):
            builder.fixed(number, component)
    return builder


def _freedoms(
    bulk: Any, builder: CalculixText, bending: set[int], held: set[int], problems: list[str]
) -> Freedoms:
    """bending: nodes of shells that bend; held: those whose rotations beams and springs hold."""
    solids, structural = set[int](), set[int]()
    for element in bulk.elements.values():
        nodes = {node for node in element.node_ids if node}
        structural |= nodes
        if element.type in SOLIDS:
            solids |= nodes
    solids -= held | leaders(bulk)
    sets = (frozenset(bending), frozenset(solids), frozenset(structural), frozenset(bending | held))
    return Freedoms(bulk, builder, *sets, problems)


def _held(bulk: Any) -> set[int]:
    """Grid points that more than shells and supports hold."""
    found = set[int]()
    for element in bulk.rigid_elements.values():
        found.update((*element.independent_nodes, *element.dependent_nodes))
    found |= {node for cards in bulk.mpcs.values() for card in cards for node in card.node_ids}
    for element in bulk.elements.values():
        if element.type not in SHELLS:
            found.update(node for node in element.node_ids if node)
    return found


def _held_rotations(bulk: Any) -> set[int]:
    """Grid points whose rotations beams and springs hold."""
    held = set[int]()
    for element in bulk.elements.values():
        if element.type in ("CBAR", "CBEAM", "CBUSH"):
            held.update(node for node in element.node_ids if node)
        elif element.type == "GENEL":
            held.update(node for node, component in matrix_components(element) if component > 3)
        elif element.type in ("CELAS1", "CELAS2"):
            ends = zip(element.node_ids, (element.c1, element.c2), strict=True)
            held.update(node for node, component in ends if node and int(component or 0) > 3)
    return held
