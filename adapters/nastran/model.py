"""A Nastran deck understood: what a campaign can update in it, and what follows from an update."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from modetune.adapters.damping import NOTHING, Dampers, damps_only
from modetune.adapters.deck_numbers import Number, moved_numbers
from modetune.adapters.nastran.additions import with_addition
from modetune.adapters.nastran.bulk import Bulk, Objection, filled, has_mass, read_bulk, refuse
from modetune.adapters.nastran.case_control import (
    OWN_PARAMETERS,
    CaseControl,
    absent_members,
    absent_sets,
    chosen_statements,
    read_case_control,
)
from modetune.adapters.nastran.constraints import fixed_components
from modetune.adapters.nastran.damping import damped_groups, dampers
from modetune.adapters.nastran.deck import NastranDeck, with_lines, write_edited
from modetune.adapters.nastran.design_export import design_text
from modetune.adapters.nastran.design_variables import read_design
from modetune.adapters.nastran.fields import CardField, changed_texts, read_number
from modetune.adapters.nastran.harmless import (
    FOLLOWED_PARAMETERS,
    HARMLESS,
    LEFT_OUT,
    TEMPERATURE_DEPENDENT,
    changing_model_parameter,
    changing_parameter,
)
from modetune.adapters.nastran.loads import load_case
from modetune.adapters.nastran.masses import lumped_properties
from modetune.adapters.nastran.mesh import BARS, read_geometry
from modetune.adapters.nastran.mystran.deck import Texts
from modetune.adapters.nastran.places import (
    ValuePlace,
    affected_elements_of,
    energy_sets,
    find_places,
    is_linear,
    powers_of,
    targets,
)
from modetune.adapters.nastran.splitting import split_materials, split_properties
from modetune.adapters.nastran.stated_units import stated_units
from modetune.adapters.nastran.structure import Structure
from modetune.adapters.solver import (
    AddedCards,
    Addition,
    AffectedElements,
    Deck,
    DesignModel,
    Edited,
    MassKind,
    ModelSummary,
    RigidLink,
    StatedUnits,
    Target,
)
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.expressions import degree
from modetune.core.mesh import Fixed, Mesh
from modetune.core.modes import Integers
from modetune.core.parameters import DAMPING, Parameter, Values, assigned, driven_by
from modetune.core.storage.files import writing
from modetune.core.updating.damping_model import DampingModel
from modetune.core.updating.observation import Observation, observe
from modetune.core.updating.static_model import LoadCase

logger = logging.getLogger(__name__)

#: Cards that reduce a model: what is left of its matrices is linear in nothing.
REDUCTIONS = ("ASET", "ASET1", "OMIT", "OMIT1")
#: The case control's choice of supports.
SUPPORT = re.compile(r"\s*SPC\s*=", re.IGNORECASE)
#: pyNastran's name of the modulus that characterises a material, by its card.
YOUNG = {"MAT1": "e", "MAT8": "e11"}


@dataclass(frozen=True, slots=True)
class EditedNastran:
    """A model with some lines of its deck changed, and the values that changed them."""

    model: NastranModel
    changed: dict[int, str]
    values: Values


@dataclass(frozen=True)
class NastranModel(Deck):
    """A deck, its cards' meaning, what pyNastran does not accept of it, and what edits it."""

    structure: Structure
    objections: tuple[Objection, ...]
    parameters: tuple[Parameter, ...]

    @property
    def deck(self) -> NastranDeck:
        return self.structure.deck

    @property
    def bulk(self) -> Bulk:
        """pyNastran's model of the deck, cross-referenced. It is shared: not to be changed."""
        return self.structure.bulk

    @cached_property
    def mystran_texts(self) -> Texts:
        """Texts of cards that are the same in all jobs for MYSTRAN; `mystran_cards` adds them."""
        return {}

    def check(self) -> None:
        """Raise ModelError for all cards that count for modes and are not understood.

        For jobs on another solver than Nastran; a warning names what these leave out.
        """
        deck, case = self.deck, read_case_control(self.deck)
        refuse(
            [
                *(item.text for item in self.objections if item.name not in HARMLESS),
                *(f"{deck.file}: {text}" for text in case.lost),
                *_lost_parameters(deck),
                *_tied_bolts(deck),
                *_temperatures(deck, case),
            ]
        )
        if not case.added("M2GG") and not any(
            map(has_mass, (*self.bulk.masses.values(), *self.bulk.elements.values()))
        ):
            raise ModelError(
                f"{deck.file}: nothing in the model has mass, so it has no modes; give its "
                "materials a density (RHO of MAT1) or grid points a CONM2"
            )
        counts = Counter(card.name for card in deck.cards if card.name in LEFT_OUT)
        names = {name for name, _ in case.parameters}
        names |= {card.text(1) for card in deck.named("PARAM")}
        texts = [f"{count} {name}" for name, count in sorted(counts.items())]
        texts += [f"PARAM {name}" for name in sorted(names - OWN_PARAMETERS - FOLLOWED_PARAMETERS)]
        texts += [
            f"`{text}` of the case control, a set that the deck does not have"
            for text in absent_sets(deck, case)
        ]
        texts += [
            f"sets of {text}, which the deck does not have" for text in absent_members(deck, case)
        ]
        if texts:
            logger.warning("%s: left out of jobs on this solver: %s", deck.file, ", ".join(texts))

    @cached_property
    def summary(self) -> ModelSummary:
        return ModelSummary(
            name=self.deck.file.stem,
            node_ids=frozenset(self.bulk.nodes),
            components=frozenset(range(1, 7)),
            n_elements=len(self.bulk.elements) + len(self.bulk.masses),
            solid_shapes=False,
            matrix_shapes=not self.deck.named(*REDUCTIONS),
            file=self.deck.file,
        )

    @cached_property
    def _mesh(self) -> Mesh:
        return read_geometry(self.bulk)

    def mesh(self) -> Mesh:
        return self._mesh

    def masses(self) -> MassKind:
        """By PARAM,COUPMASS, first that of the case control; lumped without it."""
        text = self._requested("COUPMASS")
        return "consistent" if text == "YES" or (text.isdigit() and int(text) > 0) else "lumped"

    def _requested(self, name: str) -> str:
        """Return a parameter of the deck, first that of the case control; empty without it."""
        cards = {card.text(1): card.text(2) for card in reversed(self.deck.named("PARAM"))}
        return (cards | dict(read_case_control(self.deck).parameters)).get(name, "").upper()

    def other_masses(self) -> MassKind:
        """Which masses jobs on other solvers have where the deck asks for lumped ones."""
        whole = lumped_properties(self.bulk) == frozenset(self.bulk.properties)
        if whole or self.masses() != "lumped":
            return ""
        return "consistent where elements have midside nodes"

    @property
    def wtmass(self) -> float:
        """PARAM WTMASS, the factor on all mass; 1 where the deck has none. Raises ModelError."""
        for statement in reversed(chosen_statements(self.deck)):
            if statement.parameter == "WTMASS":
                try:
                    return read_number(statement.parameter_value)
                except ValueError as error:
                    raise ModelError(f"{statement.where}: {error}") from None
        for card in self.deck.named("PARAM"):
            if card.text(1) == "WTMASS":
                return self.structure.deck.number(card, 2) or 1.0
        return 1.0

    def fixed(self) -> Fixed:
        try:
            case = read_case_control(self.deck)
        except ModelError:  # which no job can be written of
            return {}
        lost = {item.name for item in self.objections} | {c[0] for c in self.bulk.reject_cards}
        whole = lost <= HARMLESS and not self.deck.named("DMIG")
        return fixed_components(self.bulk, case.selected("SPC"), case.selected("MPC"), whole)

    def design(self) -> DesignModel:
        return read_design(self.structure)

    def targets(self) -> tuple[Target, ...]:
        return targets(self.structure)

    def elastic_constants(self) -> dict[str, tuple[float, float]]:
        """E (of a ply the one along its fibres) and density of each material, by `MAT1 30`."""
        used = set(self.structure.rods_of).union(*self.structure.materials_of.values())
        found = {}
        for number in sorted(used & self.bulk.materials.keys()):
            material = self.bulk.materials[number]
            modulus = getattr(material, YOUNG.get(material.type, ""), None)
            density = (getattr(material, "rho", None) or 0.0) * self.wtmass
            if modulus and modulus > 0.0 and density >= 0.0:
                found[f"{material.type} {number}"] = float(modulus), float(density)
        return found

    def largest_eigenvalue(self) -> float:
        """Return the approximate largest eigenvalue, also of bars without density.

        Where these join point masses it is that of a bar with two of the lightest, 2 E A / (l m).
        """
        masses = [item.mass for item in self.bulk.masses.values() if item.type == "CONM2"]
        lightest = min((mass for mass in masses if mass > 0.0), default=0.0) * self.wtmass
        found = super().largest_eigenvalue()
        for element in self.bulk.elements.values() if lightest > 0.0 else ():
            section = getattr(element, "pid_ref", None)
            material = getattr(section, "mid_ref", None)
            if element.type not in BARS or getattr(material, "rho", None) or section is None:
                continue
            young = getattr(material, "e", None) or 0.0
            length = element.Length()
            if length > 0.0:
                found = max(found, 2.0 * young * section.Area() / (length * lightest))
        return found

    def stated_units(self) -> StatedUnits | None:
        return stated_units(self.deck)

    def material_masses(self) -> dict[str, float]:
        """About the mass of each material, by `MAT1 30`; plies share that of their element."""
        found: dict[str, float] = {}
        for element in self.bulk.elements.values():
            section = getattr(element, "pid_ref", None) or element
            materials = getattr(section, "mids_ref", None) or ()
            plies = list(zip(materials, getattr(section, "thicknesses", ()), strict=False))
            parts = [(ply, ply.rho * thickness) for ply, thickness in plies if ply.type in YOUNG]
            single = getattr(section, "mid1_ref", None) or getattr(section, "mid_ref", None)
            if not plies and single is not None and single.type in YOUNG:
                parts = [(single, 1.0)]
            whole = sum(share for _, share in parts)
            mass = element.Mass() if whole > 0.0 else 0.0
            for material, share in parts if mass else ():
                name = f"{material.type} {material.mid}"
                found[name] = found.get(name, 0.0) + self.wtmass * mass * share / whole
        return found

    def places(self, parameter: Parameter) -> list[ValuePlace]:
        """Return the parameter's places. Raises ModelError with the first reason if it has none."""
        try:
            return find_places(self.structure, parameter)
        except ModelError as error:
            first = next((item for item in self.objections if item.name not in HARMLESS), None)
            if first is None:
                raise
            raise ModelError(
                f"{error}\nof the cards that are not understood: {first.text}"
            ) from None

    def numbers(self, parameter: Parameter) -> list[Number]:
        found = []
        for place in self.places(parameter):
            field = self.structure.field(place.card, place.field)
            where = self.deck.lines[field.line].where
            found.append(Number(field, place.value, where, place.along))
        return found

    def splits(self) -> tuple[str, ...]:
        return self.structure.copies.said

    def written(self, parameter: Parameter, value: float) -> float:
        """The value in the edited deck: eight columns cannot hold every number."""
        if value == 1.0 and parameter.values == "relative":
            return value
        found = []
        for number, there in moved_numbers(parameter, self.numbers(parameter), value):
            field = number.place
            (text,) = changed_texts(self.deck.lines, {field: there}).values()
            behind = len(self.deck.lines[field.line].text) - field.stop
            read = read_number(text[field.start + len(field.lead) : len(text) - behind])
            if not number.along:
                found.append(parameter.relative_to(number.value, read))
        return sum(found) / len(found) if found else value

    def edit(self, pairs: Iterable[tuple[Parameter, float]]) -> dict[int, str]:
        """New texts of the lines that these values change, by position in the deck.

        A number that stays what it is changes nothing. Raises ModelError.
        """
        values: dict[CardField, float] = {}
        for parameter, value in pairs:
            for number, there in moved_numbers(parameter, self.numbers(parameter), value):
                if there != number.value:
                    # A group's stiffness is scaled in addition to changes by others.
                    before = values.get(number.place, number.value)
                    values[number.place] = there * (before / number.value if number.value else 1.0)
        return changed_texts(self.deck.lines, values)

    def edited(self, values: Values) -> Edited:
        return EditedNastran(self, self.changed(values), values)

    def changed(self, values: Values) -> dict[int, str]:
        """New texts of the lines that the values change for jobs, which know no damping."""
        groups = values.keys() - {item.name for item in self.parameters}
        every = assigned((*self.parameters, *(self._losses if groups else ())), values)
        return self.edit(pair for pair in every if pair[0].quantity not in DAMPING)

    def with_parameters(self, more: tuple[Parameter, ...]) -> Deck:
        return type(self)(self.structure, self.objections, (*self.parameters, *more))

    def released(self) -> tuple[Deck, tuple[RigidLink, ...]] | None:
        if len(self.deck.parts) > 1:
            return None
        changed = {
            line: "$"
            for card in self.deck.named("RBE2", "RBAR", "SPC", "SPC1")
            for line in card.lines
        }
        for line in self.deck.case_control:
            if SUPPORT.match(self.deck.lines[line].text):
                changed[line] = "$"
        links = []
        for element in self.bulk.rigid_elements.values():
            if element.type == "RBE2":
                links.append(RigidLink(int(element.gn), tuple(map(int, element.Gmi))))
            elif element.type == "RBAR":
                links.append(RigidLink(int(element.ga), (int(element.gb),)))
        model = understand(with_lines(self.deck, changed), self.parameters)
        own = type(self)(model.structure, model.objections, model.parameters)
        return own, tuple(links)

    def with_cards(self, addition: Addition) -> AddedCards:
        spc = read_case_control(self.deck).selected("SPC")
        return with_addition(self.deck, self.mesh(), self.wtmass, addition, self.bulk, spc)

    def write_updated(self, values: Values, folder: Path) -> Path:
        deck = write_edited(self.deck, self.edit(assigned(self.parameters, values)), folder)
        if len(self.deck.parts) < 2:  # parts have other numbers in the deck than here
            with writing(folder / f"{deck.stem}_design.bdf") as part:
                text = design_text(self.deck, self.parameters, self.places, values)
                part.write_bytes(text.encode("utf-8", "surrogateescape"))
        return deck

    def undamped(self) -> str:
        try:
            found = self._dampers()
        except ModelError as error:
            return str(error)
        if found.links or found.losses or found.uniform:
            return ""
        return (
            f"{self.deck.file}: the deck has no damping (GE, PARAM,G, CDAMP1 to 4, CVISC, B or GE "
            "of PBUSH)"
        )

    def losses(self) -> tuple[Parameter, ...]:
        return self._losses

    @cached_property
    def _losses(self) -> tuple[Parameter, ...]:
        return damped_groups(self.structure)

    def damping(self, base: MatrixResult) -> DampingModel:
        return self._dampers().model(self, base)

    def _dampers(self) -> Dampers:
        """What damps the model. Raises ModelError."""
        try:
            uniform = read_number(self._requested("G") or "0")
        except ValueError as error:
            raise ModelError(f"{self.deck.file}: PARAM,G: {error}") from None
        return dampers(self.structure, self, self.parameters, uniform)

    def bulk_at(self, changed: dict[int, str]) -> Bulk:
        """pyNastran's model of the deck with some lines changed. Raises ModelError."""
        return read_bulk(with_lines(self.deck, changed))[0] if changed else self.bulk

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        if not parameter.proportional or driven_by(parameter, self.parameters):
            return ()
        return energy_sets(self.structure, parameter)

    def set_elements(self, name: str) -> frozenset[int]:
        """Elements of a group that energy_sets names."""
        number = int(name[1:])
        if name.startswith("E"):
            return frozenset({number})
        return self.structure.elements_of.get(number, frozenset())

    def is_linear(self, parameter: Parameter) -> bool:
        """Whether stiffness and mass matrices are linear in the parameter."""
        driven = driven_by(parameter, self.parameters)
        return is_linear(self.structure, parameter) and all(
            degree(item.expression) < 2 and is_linear(self.structure, item) for item in driven
        )

    def affected_elements(self, parameter: Parameter) -> AffectedElements | None:
        if damps_only(parameter, self.parameters):
            return NOTHING
        if self.problems((parameter,)):
            return None
        items = (parameter, *driven_by(parameter, self.parameters))
        places = [self.places(item) for item in items]
        powers = powers_of(parameter, places[0], self.is_linear(parameter))
        if not powers or (powers != (1,) and not (parameter.proportional and len(items) == 1)):
            return None
        whole = bool(self.energy_sets(parameter))
        return affected_elements_of(self.structure, items, places, powers, whole)

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(matrices, nodes, components)

    def load_case(self, number: int, values: Values | None = None) -> LoadCase:
        return load_case(self.structure, self.mesh(), number)


def understand(deck: NastranDeck, parameters: tuple[Parameter, ...] = ()) -> NastranModel:
    """Return the model of a deck's cards, with separate cards for the elements of parameters.

    Raises ModelError where it is no Nastran deck, or where a card cannot be copied.
    """
    bulk, owners, objections = read_bulk(deck)
    structure = Structure(deck, bulk, owners)
    for split in (split_properties, split_materials):
        found = split(structure, parameters)
        if found is not None:
            deck, copies = found
            bulk, owners, objections = read_bulk(deck)
            structure = Structure(deck, bulk, owners, structure.copies.with_(copies))
    return NastranModel(structure, objections, parameters)


def _lost_parameters(deck: NastranDeck) -> Iterator[str]:
    """Parameters of the bulk data that change modes, a sentence each."""
    for card in deck.named("PARAM", "MDLPRM"):
        pairs = range(1, len(card.fields), 2) if card.name == "MDLPRM" else (1,)
        changing = changing_model_parameter if card.name == "MDLPRM" else changing_parameter
        for place in pairs:
            reason = changing(card.text(place), card.text(place + 1))
            if reason:
                yield f"{deck.where(card)}: {reason}"


def _tied_bolts(deck: NastranDeck) -> Iterator[str]:
    """Bolts that join two halves of a mesh; those that name elements alone are preloads."""
    for card in deck.named("BOLT"):
        if not all(text.isdecimal() or text == "THRU" for text in filled(card, None) if text):
            yield f"{deck.where(card)}: BOLT joins grid points, which is not translated"


def _temperatures(deck: NastranDeck, case: CaseControl) -> Iterator[str]:
    """Materials that depend on a temperature which the case control selects."""
    dependent = deck.named(*TEMPERATURE_DEPENDENT)
    if dependent and case.temperature:
        yield (
            f"{deck.where(dependent[0])}: {dependent[0].name} makes the material depend "
            f"on the temperature that `{case.temperature}` selects, which jobs on this solver "
            "do not follow; give the material its values at that temperature and take "
            f"{dependent[0].name} or the selection out"
        )
