"""Nastran bulk data as the model part of a CalculiX deck, or a refusal that names every obstacle.

The grid points keep their numbers; what a card needs besides (midside nodes, rotations, the pieces
of a rigid mass) gets nodes beyond them. Every property has an element set `P<pid>`.

A card that is on neither list here is refused: one that is dropped in silence is a wrong model.
Real normal modes know no loads, no damping, no design variables and no requests for output.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from modetune.adapters.calculix.deck import KeywordDeck, parse_deck
from modetune.adapters.nastran.harmless import HARMLESS
from modetune.adapters.nastran.masses import (
    lumped_properties,
    lumped_solids,
    lumps,
    solid_densities,
)
from modetune.adapters.translation.assembly import Assembly, Freedoms
from modetune.adapters.translation.beams import translate_beams
from modetune.adapters.translation.calculix_text import CalculixText
from modetune.adapters.translation.concentrated_masses import (
    grouped_masses,
    point_masses,
    translate_masses,
    translate_scalar_masses,
)
from modetune.adapters.translation.linear_constraints import (
    leaders,
    translate_mpcs,
    translate_rigid_elements,
    translate_spcs,
)
from modetune.adapters.translation.mass_properties import (
    MassProperties,
    calculix_mass_properties,
    check_masses,
    nastran_mass_properties,
)
from modetune.adapters.translation.shear_panels import translate_shear_panels
from modetune.adapters.translation.shells import KINDS as SHELLS
from modetune.adapters.translation.shells import (
    WrittenShells,
    hold_leaders,
    lumped_shells,
    shell_densities,
    understand_shells,
    write_shells,
)
from modetune.adapters.translation.solids import KINDS as SOLIDS
from modetune.adapters.translation.solids import translate_solids
from modetune.adapters.translation.springs import translate_springs
from modetune.adapters.translation.stiffness_matrices import (
    added_rotations,
    matrix_components,
    translate_added_mass,
    translate_matrices,
)
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

#: Translated, or looked at where they are used.
TRANSLATED = frozenset(
    "GRID SPOINT CORD1R CORD1C CORD1S CORD2R CORD2C CORD2S "
    "CHEXA CPENTA CTETRA CPYRAM CSHEAR PSHEAR CQUAD4 CQUAD8 CQUADR CTRIA3 CTRIA6 CTRIAR "
    "CBAR CBEAM CROD CONROD CTUBE CELAS1 CELAS2 CELAS3 CELAS4 CBUSH CBUSH1D GENEL CONM1 CONM2 "
    "CMASS1 CMASS2 CMASS3 CMASS4 PMASS "
    "PSHELL PCOMP PCOMPG PSOLID PLSOLID PBAR PBARL PBEAM PBEAML PBCOMP PROD PTUBE PELAS PBUSH "
    "PBUSH1D DMIG "
    "MAT1 MAT2 MAT3 MAT8 MAT9 MAT10 MAT11 RBE1 RBE2 RBE3 RBAR RROD RSPLINE RBAR1 "
    "SPC SPC1 SPCADD SPCOFF SPCOFF1 MPC MPCADD PARAM MDLPRM".split()
)
#: No DMIG at all.
NONE_ADDED: Mapping[str, Sequence[tuple[float, str]]] = {}
#: Families of cards of which those count alone that elements use.
BY_USE = ("P", "MAT")


def refused_cards(bulk: Any) -> list[str]:
    """Return a sentence for each kind of card that can be neither translated nor left out."""
    counts = {name.upper(): count for name, count in bulk.card_count.items()}
    used = _used_kinds(bulk)
    found = [
        f"{name}: {count} card{'s' if count > 1 else ''}{_numbers(bulk, name)} not translated"
        for name, count in sorted(counts.items())
        if name not in TRANSLATED
        and name not in HARMLESS
        and count
        and (name in used or not name.startswith(BY_USE))
    ]
    return found


def _used_kinds(bulk: Any) -> set[str]:
    """Return names of the properties that elements have, and of their materials."""
    found = set[str]()
    for element in bulk.elements.values():
        card = getattr(element, "pid_ref", None) or element
        names = ("mid_ref", "mid1_ref", "mid2_ref", "mid3_ref", "mid4_ref")
        materials = [getattr(card, name, None) for name in names]
        materials += list(getattr(card, "mids_ref", None) or [])
        found.update(item.type for item in (card, *materials) if item is not None)
    return found


def _numbers(bulk: Any, name: str) -> str:
    try:
        numbers = sorted(bulk.get_card_ids_by_card_types([name])[name])
    except (KeyError, TypeError, RuntimeError):
        return ""
    return f" ({shortened(numbers)})" if numbers else ""


def shortened(numbers: Iterable[Any]) -> str:
    """Return the first few numbers of many."""
    words = [str(number) for number in numbers]
    return ", ".join(words[:5]) + (f", ... {words[-1]}" if len(words) > 5 else "")


def summarised(problems: Iterable[str]) -> list[str]:
    """Return one sentence for all cards of a kind that have the same problem."""
    groups: dict[tuple[str, str], list[str]] = {}
    for problem in dict.fromkeys(problems):
        found = re.fullmatch(r"([A-Z]+\d?) (\d+)(\D.*)", problem, re.DOTALL)
        kind, number, reason = found.groups() if found else ("", "", problem)
        groups.setdefault((kind, reason), []).append(number)
    sentences = []
    for (kind, reason), numbers in groups.items():
        many = f" ({len(numbers)} of them)" if len(numbers) > 1 else ""
        sentences.append(f"{kind} {shortened(numbers)}{many}{reason}" if kind else reason)
    return sentences


@dataclass(frozen=True, slots=True)
class Translation:
    """A CalculiX model part and what is needed to read its results as the Nastran model's.

    deck: *NODE to *BOUNDARY, no step. frames: grid point to (3, 3), basic-to-CD rotation, of those
    whose output frame is not the basic one. sets: names of all element sets of structural
    elements. grids: the bulk data's grid points, ascending. mass: mass properties that the cards
    say, WTMASS in them; mass_check: a sentence on how the translated ones agree, empty
    without that comparison. shells: the materials of their laws. carriers: nodes whose
    translations are the rotations of a grid point, and that point.
    """

    deck: KeywordDeck
    frames: dict[int, Floats]
    sets: tuple[str, ...]
    grids: tuple[int, ...]
    mass: MassProperties
    mass_check: str
    shells: WrittenShells
    carriers: dict[int, int]

    @property
    def text(self) -> str:
        """Of the deck."""
        return "\n".join(line.text for line in self.deck.lines)


def translate(
    bulk: Any,
    name: str,
    single: frozenset[int] = frozenset(),
    spc: int = 0,
    mpc: int = 0,
    added: Mapping[str, Sequence[tuple[float, str]]] = NONE_ADDED,
    wtmass: float = 1.0,
    weighed: bool = True,
    lumped: bool = False,
) -> Translation:
    """Translate a cross-referenced pyNastran BDF.

    name: of the deck, for messages. single: elements that get a separate set `E<eid>`. spc,
    mpc: constraint sets, 0 for none. added: factors and names of the DMIG that K2GG and M2GG add.
    wtmass: the factor on all masses but M2GG, PARAM,WTMASS. weighed: whether the masses are held
    against the cards'. lumped: whether elements' masses are at their grid points alone, where they
    can be.
    Raises ModelError with every card and feature that cannot be translated.
    """
    if not bulk.nodes and not bulk.spoints:
        raise ModelError(f"{name} has no GRID and no SPOINT, so there is nothing to translate")
    problems = refused_cards(bulk)
    builder = _builder(bulk)

    shells, edges = understand_shells(bulk, builder, problems)
    held = _held_rotations(bulk) | added_rotations(bulk, added.get("K2GG", ()))
    bending = {node for shell in shells if shell.law.bends for node in shell.nodes}
    freedoms = _freedoms(bulk, builder, bending, held, problems)
    at_nodes = lumped_properties(bulk) if lumped else frozenset[int]()
    model = Assembly(bulk, freedoms, single, wtmass, lumped, at_nodes)
    translate_solids(model)
    translate_spcs(bulk, freedoms, edges, spc, problems)
    translate_mpcs(bulk, freedoms, mpc, problems)
    translate_rigid_elements(bulk, freedoms, edges, problems)
    translate_beams(model)
    translate_springs(model)
    translate_matrices(model, added.get("K2GG", ()))
    translate_shear_panels(model)
    densities = solid_densities(bulk, at_nodes)
    parts = lumped_solids(bulk, densities) + lumped_shells(shells, builder, at_nodes)
    densities |= shell_densities(shells)
    masses, groups = grouped_masses(lumps(parts), densities)
    masses = point_masses(bulk, problems) + masses
    translate_masses(model, masses)
    translate_scalar_masses(model)
    translate_added_mass(model, added.get("M2GG", ()))
    written = write_shells(model, shells, edges, _held(bulk), groups, densities)
    hold_leaders(freedoms, leaders(bulk) - held - freedoms.turning)
    if problems:
        found = "\n".join(f"- {problem}" for problem in summarised(problems))
        raise ModelError(f"{name} cannot be translated to CalculiX:\n{found}")
    # It is not a file: messages name it as what it is.
    deck = parse_deck(Path(f"{name} (translated to CalculiX)"), builder.text())
    expected, check = nastran_mass_properties(model, shells, masses), ""
    if weighed:
        check = check_masses(expected, calculix_mass_properties(builder, deck), builder.size)
    frames = {number: frame for number, frame in freedoms.frames.items() if number in bulk.nodes}
    sets = tuple(name for name in builder.sets if re.fullmatch(r"[PE]\d+", name))
    grids = tuple(sorted(bulk.nodes))
    carriers = {carrier: node for node, carrier in freedoms.turn_nodes.items()}
    return Translation(deck, frames, sets, grids, expected, check, written, carriers)


def _builder(bulk: Any) -> CalculixText:
    """Return a builder with all grid points."""
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
    """Return the freedoms; bending: nodes of shells that bend; held: rotations held by others."""
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
    """Return grid points that more than shells and supports hold."""
    found = set[int]()
    for element in bulk.rigid_elements.values():
        found.update((*element.independent_nodes, *element.dependent_nodes))
    found |= {node for cards in bulk.mpcs.values() for card in cards for node in card.node_ids}
    for element in bulk.elements.values():
        if element.type not in SHELLS:
            found.update(node for node in element.node_ids if node)
    return found


def _held_rotations(bulk: Any) -> set[int]:
    """Return grid points whose rotations beams and springs hold."""
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
