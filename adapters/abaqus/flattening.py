"""A deck of parts and instances as one flat CalculiX deck, or a refusal that names the obstacle.

Sections, materials and masses keep the text of their data lines, so that a number of the flat deck
is a number of the author's. What belongs to an instance is named `INSTANCE.NAME`; an instance that
is not turned and one that is are written alike. A keyword that is on no list here is refused: one
that is dropped in silence is a wrong model.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from modetune.adapters.abaqus.connections import Connections, read_connections
from modetune.adapters.abaqus.instances import (
    AssemblyMesh,
    Scope,
    read_assembly,
    refuse_options,
    vectors,
)
from modetune.adapters.calculix.deck import (
    KeywordCard,
    KeywordDeck,
    canonical_name,
    deck_of,
    format_number,
)
from modetune.adapters.calculix.steps import frequency_steps, modal_step, read_steps
from modetune.core.errors import ModelError

#: Components that a named condition holds.
CONDITIONS: dict[str, tuple[int, ...]] = {
    "ENCASTRE": (1, 2, 3, 4, 5, 6), "PINNED": (1, 2, 3),
    "XSYMM": (1, 5, 6), "YSYMM": (2, 4, 6), "ZSYMM": (3, 4, 5),
    "XASYMM": (2, 3, 4), "YASYMM": (1, 3, 5), "ZASYMM": (1, 2, 6),
}  # fmt: skip
#: Elements whose counterpart has the same nodes and another formulation, with what is said of it.
OTHER_FORMULATION = {
    "C3D10M": "C3D10", "C3D10I": "C3D10", "C3D10HS": "C3D10",
    "S3R": "S3", "S4R": "S4",
}  # fmt: skip
#: Requests for output and notes: nothing of the model.
IDLE = frozenset(
    "*HEADING *PREPRINT *RESTART *OUTPUT *NODEOUTPUT *ELEMENTOUTPUT *ENERGYOUTPUT *CONTACTOUTPUT "
    "*MODALOUTPUT *INTEGRATEDOUTPUT *NODEPRINT *ELPRINT *NODEFILE *ELFILE *MODALPRINT *MODALFILE "
    "*MONITOR *AMPLITUDE *PHYSICALCONSTANTS *FILTER *SECTIONCONTROLS *TIMEPOINTS *FILEFORMAT "
    "*SURFACEINTERACTION *FRICTION *SURFACEBEHAVIOR *GAPCONDUCTANCE *ENDSTEP *CONTROLS".split()
)
#: Of a material: kept, and what has no part in small vibrations about the unloaded state.
KEPT_MATERIAL = frozenset({"*ELASTIC", "*DENSITY", "*DAMPING"})
IDLE_MATERIAL = frozenset(
    "*PLASTIC *EXPANSION *CONDUCTIVITY *SPECIFICHEAT *DAMAGEINITIATION *DAMAGEEVOLUTION *CREEP "
    "*RATEDEPENDENT *FAILSTRAIN *FAILSTRESS *DEPVAR *CYCLICHARDENING *LATENTHEAT".split()
)
#: Of the mesh: read before, by the connections, or written here.
OF_SCOPES = frozenset(
    "*NODE *ELEMENT *NSET *ELSET *SURFACE *COUPLING *KINEMATIC *DISTRIBUTING *MPC *EQUATION "
    "*KINEMATICCOUPLING *RIGIDBODY *ROTARYINERTIA *SOLIDSECTION *SHELLSECTION *BEAMSECTION "
    "*ORIENTATION *TRANSFORM *TIE *MASS *SPRING *DASHPOT".split()
)  # fmt: skip
#: Length and breadth of a stub in the model's size, and its set and material.
STUB, STUBS = 1e-4, "MODETUNE_STUBS"
#: Entries of a line that ccx reads.
ENTRIES = 16
#: Characters of a name that ccx reads.
LONGEST = 80


@dataclass(frozen=True, slots=True)
class FlatDeck:
    """The flat deck, and where its lines come from.

    source: the author's deck. origins: (n_lines,), the position there of each line of `deck`, whose
    text it has if it is a data line of a material or a section. labels: `WING-1.12` by flat number.
    """

    deck: KeywordDeck
    source: KeywordDeck
    origins: tuple[int, ...]
    labels: Mapping[int, str]
    notes: tuple[str, ...]


def has_assembly(deck: KeywordDeck) -> bool:
    """Whether a deck has parts or instances, or supports by name: ccx reads none of them."""
    return bool(deck.named("*PART", "*INSTANCE", "*ASSEMBLY")) or any(
        canonical_name(text) in CONDITIONS
        for card in deck.named("*BOUNDARY")
        for line in card.data
        for text in deck.fields(line)[1:2]
    )


def flatten(deck: KeywordDeck) -> FlatDeck:
    """Write the parts of a deck as instances place them. Raises ModelError with what cannot be."""
    for card in deck.cards:
        if "INPUT" in card.options:
            text = f"{deck.where(card)}: {card.keyword}, INPUT= of another file is not translated"
            raise ModelError(text)
    mesh = read_assembly(deck)
    writer = Writer(mesh, read_connections(mesh))
    writer.write()
    lines = [deck.lines[origin]._replace(text=text) for text, origin in writer.lines]
    origins = tuple(origin for _, origin in writer.lines)
    notes = tuple(_notes(mesh))
    return FlatDeck(deck_of(deck.file, lines), deck, origins, dict(mesh.labels), notes)


def _notes(mesh: AssemblyMesh) -> Iterable[str]:
    counts = defaultdict[str, int](int)
    for item in mesh.elements.values():
        counts[item.given] += item.given in OTHER_FORMULATION
    for given, count in counts.items():
        if count:
            text = f"{mesh.deck.file}: {count} {given} are {OTHER_FORMULATION[given]} in CalculiX"
            yield f"{text}, of another formulation: frequencies of a coarse mesh differ"


class Writer:
    """A mutable list of the flat deck's lines, each with its position in the author's deck."""

    def __init__(self, mesh: AssemblyMesh, ties: Connections) -> None:
        self.mesh, self.deck, self.ties = mesh, mesh.deck, ties
        self.lines: list[tuple[str, int]] = []

    def write(self) -> None:
        scopes = list(self.mesh.scopes.values())
        self._nodes()
        self._elements()
        for scope in scopes:
            for card in scope.cards:
                self._set(scope, card)
        for scope in scopes:
            for card in scope.cards:
                self._orientation(scope, card)
        materials = [card for card in self.mesh.others if not self._in_step(card)]
        self._materials(materials)
        for scope in scopes:
            for card in scope.cards:
                self._section(scope, card)
        for scope in scopes:
            for card in scope.cards:
                self._surface(scope, card)
        self._stubs()
        self.lines += self.ties.lines()
        self._inertias()
        for scope in scopes:
            for card in scope.cards:
                self._tie(scope, card)
        for scope in scopes:
            for card in (*scope.cards, *(materials if not scope.name else ())):
                if card.is_one_of("*BOUNDARY"):
                    self._boundary(scope, card)
        self._steps()

    def add(self, text: str, origin: int) -> None:
        self.lines.append((text, origin))

    def header(self, card: KeywordCard, keyword: str, **options: str) -> None:
        words = [f"{name}={value}" if value else name for name, value in options.items()]
        self.add(", ".join([keyword, *words]), card.lines.start)

    def rows(self, words: Sequence[object], origin: int) -> None:
        for at in range(0, len(words), ENTRIES):
            self.add(", ".join(map(str, words[at : at + ENTRIES])), origin)

    def _in_step(self, card: KeywordCard) -> bool:
        steps = self.deck.named("*STEP")
        return bool(steps) and card.lines.start >= steps[0].lines.start

    def _nodes(self) -> None:
        for scope, card, flats in self.mesh.nodes_of:
            name = {"NSET": scope.flat(card.option("NSET"))} if card.option("NSET") else {}
            self.header(card, "*NODE", **name)
            origins = dict(zip(flats, card.data, strict=False))
            for flat in flats:
                if flat not in self.mesh.places:  # merged with another
                    continue
                place = ", ".join(format_number(value) for value in self.mesh.places[flat].tolist())
                self.add(f"{flat}, {place}", origins.get(flat, card.lines.start))
        if self.ties.made:
            self.add("*NODE", 0)
        for flat, xyz in self.ties.made.items():
            self.add(f"{flat}, {', '.join(format_number(x) for x in xyz.tolist())}", 0)

    def _elements(self) -> None:
        for scope, card, flats in self.mesh.elements_of:
            kept = [flat for flat in flats if self.mesh.elements[flat].kind]
            if not kept:
                continue
            set_name = card.option("ELSET")
            name = {"ELSET": self.name(scope, set_name, card)} if set_name else {}
            self.header(card, "*ELEMENT", TYPE=self.mesh.elements[kept[0]].kind, **name)
            one_line = len(card.data) == len(flats)
            origins = dict(zip(flats, card.data, strict=False)) if one_line else {}
            for flat in kept:
                words = [flat, *self.mesh.elements[flat].nodes]
                for at in range(0, len(words), ENTRIES):
                    more = "," if at + ENTRIES < len(words) else ""
                    text = ", ".join(map(str, words[at : at + ENTRIES]))
                    self.add(text + more, origins.get(flat, card.lines.start))

    def name(self, scope: Scope, name: str, card: KeywordCard) -> str:
        """What the flat deck calls something of a scope. Raises ModelError where it is too long."""
        own, local = self.mesh.owner(scope, name)
        found = own.flat(local)
        if len(found) > LONGEST:
            text = f"{found} is longer than the {LONGEST} characters that CalculiX reads"
            raise ModelError(f"{self.deck.where(card)}: the name {text}")
        return found

    def _set(self, scope: Scope, card: KeywordCard) -> None:
        if not card.is_one_of("*NSET", "*ELSET"):
            return
        keyword, nodal = card.keyword, card.is_one_of("*NSET")
        local = card.option(keyword[1:])
        first = next(
            other
            for other in scope.cards
            if other.keyword == keyword and other.option(keyword[1:]) == local
        )
        if first is not card:  # the first card of a name has all its members
            return
        if nodal:
            members = scope.node_sets[local]
        else:
            numbers = scope.element_sets[local]
            members = [flat for flat in numbers if self.mesh.elements[flat].kind]
        if members:
            self.header(card, keyword, **{keyword[1:]: self.name(scope, local, card)})
            self.rows(members, card.lines.start)

    def _kinds(self, scope: Scope, card: KeywordCard) -> set[str]:
        found = self.mesh.element_set(scope, card.option("ELSET"), self.deck.where(card))
        return {self.mesh.elements[flat].kind for flat in found}

    def _orientation(self, scope: Scope, card: KeywordCard) -> None:
        if card.is_one_of("*TRANSFORM"):
            return self._transform(scope, card)
        if not card.is_one_of("*ORIENTATION"):
            return None
        where, system = self.deck.where(card), card.option("SYSTEM") or "RECTANGULAR"
        refuse_options(self.deck, card, {"NAME", "SYSTEM", "DEFINITION"})
        if card.option("DEFINITION") not in ("", "COORDINATES"):
            text = f"DEFINITION={card.option('DEFINITION')} of orientation {card.option('NAME')}"
            raise ModelError(f"{where}: {text} is not translated")
        if system not in ("RECTANGULAR", "CYLINDRICAL") or not card.data:
            raise ModelError(f"{where}: orientation {card.option('NAME')}, SYSTEM={system} is not "
                             "translated")  # fmt: skip
        first, second, origin = vectors(self.deck, card.data[0], 3)
        if system == "RECTANGULAR":
            points = [scope.rotation @ (first - origin), scope.rotation @ (second - origin)]
        else:
            points = [scope.rotation @ point + scope.shift for point in (first, second)]
        name = scope.flat(card.option("NAME"))
        self.header(card, "*ORIENTATION", NAME=name, SYSTEM=system)
        words = [format_number(value) for point in points for value in point.tolist()]
        self.add(", ".join(words), card.data[0])
        if len(card.data) > 1:
            self.add(self.deck.lines[card.data[1]].text, card.data[1])
        return None

    def _transform(self, scope: Scope, card: KeywordCard) -> None:
        refuse_options(self.deck, card, {"NSET", "TYPE"})
        kind = card.option("TYPE") or "R"
        if kind not in ("R", "C") or not card.data:
            raise ModelError(f"{self.deck.where(card)}: *TRANSFORM, TYPE={kind} is not translated")
        points = vectors(self.deck, card.data[0], 2) @ scope.rotation.T
        points = points + scope.shift if kind == "C" else points
        self.header(card, "*TRANSFORM", NSET=self.name(scope, card.option("NSET"), card), TYPE=kind)
        words = [format_number(value) for value in points.ravel().tolist()]
        self.add(", ".join(words), card.data[0])

    def _materials(self, cards: Sequence[KeywordCard]) -> None:
        """Copy the materials, lines as they are."""
        name = ""
        for card in cards:
            where = self.deck.where(card)
            if card.is_one_of("*MATERIAL"):
                name = card.option("NAME")
                self.header(card, "*MATERIAL", NAME=name)
            elif card.keyword in KEPT_MATERIAL and name:
                self._material_card(card, name)
            elif card.keyword in IDLE_MATERIAL and name:
                continue
            elif card.is_one_of("*BOUNDARY") or card.keyword in IDLE:
                name = ""
            else:
                of = f" of material {name}" if name else ""
                named = "".join(f" {card.option(o)}" for o in ("NAME", "TYPE") if card.option(o))
                raise ModelError(f"{where}: {card.keyword}{named}{of} is not translated")

    def _material_card(self, card: KeywordCard, name: str) -> None:
        where, kind = self.deck.where(card), card.option("TYPE")
        if card.is_one_of("*ELASTIC"):
            refuse_options(self.deck, card, {"TYPE", "MODULI"})
            if not kind.startswith(("ISO", "ENGINEERINGCONSTANTS", "ORTHO", "ANISO")) and kind:
                text = f"*ELASTIC, TYPE={kind} of material {name}"
                raise ModelError(f"{where}: {text} is not translated")
            options = {"TYPE": "ENGINEERING CONSTANTS" if kind.startswith("ENG") else kind}
            self.header(card, "*ELASTIC", **(options if kind else {}))
        elif card.is_one_of("*DENSITY"):
            refuse_options(self.deck, card, set())
            self.header(card, "*DENSITY")
        else:
            self.add(self.deck.lines[card.lines.start].text, card.lines.start)
        for line in card.data:
            self.add(self.deck.lines[line].text, line)

    def _section(self, scope: Scope, card: KeywordCard) -> None:
        if card.is_one_of("*SOLID SECTION", "*SHELL SECTION", "*BEAM SECTION"):
            self._solid_shell_beam(scope, card)
        elif card.is_one_of("*MASS", "*SPRING", "*DASHPOT"):
            self._point_section(scope, card)
        elif card.keyword not in OF_SCOPES and card.keyword not in IDLE | {"*BOUNDARY"}:
            named = "".join(
                f" {card.option(o)}" for o in ("NAME", "ELSET", "TYPE") if card.option(o)
            )
            place = scope.part or scope.name
            of = f" of part {place}" if place else ""
            text = f"{card.keyword}{named}{of} is not translated"
            raise ModelError(f"{self.deck.where(card)}: {text}")

    def _solid_shell_beam(self, scope: Scope, card: KeywordCard) -> None:
        known = {
            "*SOLIDSECTION": {"CONTROLS"},
            "*SHELLSECTION": {"CONTROLS", "OFFSET", "SECTIONINTEGRATION", "POISSON", "TEMPERATURE"},
            "*BEAMSECTION": {"SECTION", "TEMPERATURE", "POISSON"},
        }[card.keyword]
        refuse_options(self.deck, card, {"ELSET", "MATERIAL", "ORIENTATION", *known})
        where, kinds = self.deck.where(card), self._kinds(scope, card)
        if not any(kinds):
            return
        options = {
            "ELSET": self.name(scope, card.option("ELSET"), card),
            "MATERIAL": card.option("MATERIAL"),
        }
        if card.option("OFFSET") and card.option("OFFSET").strip("0.+-E"):
            text = f"OFFSET={card.option('OFFSET')} of {options['ELSET']}"
            raise ModelError(f"{where}: *SHELL SECTION, {text} is not translated")
        if turned := card.option("ORIENTATION"):
            self._check_orientation(scope, card, turned)
            options["ORIENTATION"] = scope.flat(turned)
        if card.is_one_of("*BEAM SECTION"):
            return self._beam(scope, card, options)
        keyword = "*SOLID SECTION" if card.is_one_of("*SOLID SECTION") else "*SHELL SECTION"
        self.header(card, keyword, **options)
        solid = all(kind.startswith("C3D") for kind in kinds)
        for line in card.data[:1]:
            if not solid:
                self.add(self.deck.lines[line].text, line)
        return None

    def _check_orientation(self, scope: Scope, card: KeywordCard, name: str) -> None:
        """Raise ModelError for an orientation that is lost, or means another thing to ccx."""
        where = self.deck.where(card)
        found = [
            other
            for other in scope.cards
            if other.is_one_of("*ORIENTATION") and other.option("NAME") == name
        ]
        if not found:
            raise ModelError(
                f"{where}: orientation {name} of {scope.part or scope.name} is not there"
            )
        axis = self.deck.fields(found[0].data[1])[0] if len(found[0].data) > 1 else "1"
        plain = self._isotropic(card.option("MATERIAL"))
        if card.is_one_of("*SHELL SECTION") and axis != "3" and not plain:
            text = f"orientation {name} of shells turns about axis {axis}, and 3 is the one that"
            raise ModelError(f"{where}: {text} CalculiX has in common")

    def _isotropic(self, material: str) -> bool:
        name = ""
        for card in self.mesh.others:
            if card.is_one_of("*MATERIAL"):
                name = card.option("NAME")
            elif card.is_one_of("*ELASTIC") and name == material:
                return card.option("TYPE").startswith("ISO") or not card.option("TYPE")
        return False

    def _beam(self, scope: Scope, card: KeywordCard, options: dict[str, str]) -> None:
        where, shape = self.deck.where(card), card.option("SECTION")
        if shape not in ("RECT", "CIRC") or not card.data:
            text = f"*BEAM SECTION, SECTION={shape} of {options['ELSET']}"
            raise ModelError(f"{where}: {text} is not translated")
        self.header(card, "*BEAM SECTION", **options, SECTION=shape)
        if shape == "CIRC":  # ccx takes diameters
            size = format_number(2.0 * self.deck.number(card.data[0], 0))
            self.add(f"{size}, {size}", card.data[0])
        else:
            self.add(self.deck.lines[card.data[0]].text, card.data[0])
        line = card.data[1] if len(card.data) > 1 else card.data[0]
        (across,) = vectors(self.deck, line, 1) if len(card.data) > 1 else [[0.0, 0.0, -1.0]]
        words = [format_number(value) for value in (scope.rotation @ across).tolist()]
        self.add(", ".join(words), line)

    def _point_section(self, scope: Scope, card: KeywordCard) -> None:
        where, name = self.deck.where(card), self.name(scope, card.option("ELSET"), card)
        known = {"*MASS": {"ALPHA", "COMPOSITE"}}.get(card.keyword, set())
        refuse_options(self.deck, card, {"ELSET", *known})
        kinds = self._kinds(scope, card)
        lines = [line for line in card.lines if line > card.lines.start]
        lines = [line for line in lines if not self.deck.lines[line].text.startswith("**")]
        self.header(card, card.keyword, ELSET=name)
        if card.is_one_of("*MASS"):
            lines = list(card.data[:1])
        elif kinds <= {"SPRINGA", "DASHPOTA"}:
            # Abaqus and ccx both skip the line of directions, which these have not.
            self.add("", card.lines.start)
            lines = list(card.data[-1:])
        elif kinds <= {"SPRING1", "SPRING2"}:
            words = [text for text in self.deck.fields(card.data[0]) if text] if card.data else []
            if not words or not all(word in ("1", "2", "3") for word in words):
                raise ModelError(f"{where}: a spring along {', '.join(words)} of {name} is not "
                                 "translated")  # fmt: skip
            if scope.turned:
                raise ModelError(f"{where}: spring {name} has directions in a turned instance")
            lines = list(card.data)
        else:
            raise ModelError(f"{where}: {card.keyword} of {', '.join(sorted(kinds))}, {name}")
        for line in lines:
            self.add(self.deck.lines[line].text, line)

    def _tied(self) -> set[str]:
        """Names of the surfaces that ties have."""
        return {
            self.name(scope, canonical_name(text), card)
            for scope in self.mesh.scopes.values()
            for card in scope.cards
            if card.is_one_of("*TIE")
            for line in card.data
            for text in self.deck.fields(line)
            if text
        }

    def _surface(self, scope: Scope, card: KeywordCard) -> None:
        if not card.is_one_of("*SURFACE") or card.option("TYPE") not in ("", "ELEMENT", "NODE"):
            return
        name, where = self.name(scope, card.option("NAME"), card), self.deck.where(card)
        if name not in self._tied():  # couplings have read theirs
            return
        refuse_options(self.deck, card, {"TYPE", "NAME", "INTERNAL"})
        nodal = card.option("TYPE") == "NODE"
        self.header(card, "*SURFACE", NAME=name, TYPE="NODE" if nodal else "ELEMENT")
        for line in card.data:
            first, second, *_ = [*self.deck.fields(line), "", ""]
            if nodal:
                for node in self.mesh.node_set(scope, first, self.deck.lines[line].where):
                    self.add(str(node), line)
                continue
            elements = self.mesh.element_set(scope, first, self.deck.lines[line].where)
            if not second or any(
                not self.mesh.elements[e].kind.startswith("C3D") for e in elements
            ):
                text = f"surface {name} has a face {second or '(blank)'} of {first}"
                raise ModelError(f"{where}: {text}, which is not translated in a *TIE")
            for element in elements:
                self.add(f"{element}, {canonical_name(second)}", line)

    def _stubs(self) -> None:
        """Short beams at nodes whose rotations are tied, of the deck's first material."""
        if not self.ties.stubs:
            return
        origin, size = next(iter(self.ties.stubs.values())), STUB * self.ties.size
        first, node = max(self.mesh.elements) + 1, self.ties.new_node(np.zeros(3)) - 1
        self.add("*NODE", origin)
        for place, (own, line) in enumerate(self.ties.stubs.items(), 1):
            xyz = self.mesh.places[own] + (0.0, 0.0, size)
            self.add(f"{node + place}, {', '.join(map(format_number, xyz.tolist()))}", line)
        self.add(f"*ELEMENT, TYPE=B31, ELSET={STUBS}", origin)
        for place, (own, line) in enumerate(self.ties.stubs.items(), 1):
            self.add(f"{first + place}, {own}, {node + place}", line)
        self.add(f"*MATERIAL, NAME={STUBS}", origin)
        self.lines += [(text, origin) for text in self._first_material()]
        self.add(f"*BEAM SECTION, ELSET={STUBS}, MATERIAL={STUBS}, SECTION=RECT", origin)
        self.add(f"{format_number(size)}, {format_number(size)}", origin)
        self.add("1., 0., 0.", origin)

    def _first_material(self) -> list[str]:
        """Modulus and density of the first isotropic material, for stubs."""
        found = dict[str, float]()
        for card in self.mesh.others:
            if card.is_one_of("*ELASTIC", "*DENSITY") and card.data and not card.options:
                found.setdefault(card.keyword, self.deck.number(card.data[0], 0))
        modulus, density = (format_number(found.get(k, 1.0)) for k in ("*ELASTIC", "*DENSITY"))
        return ["*ELASTIC", f"{modulus}, 0.", "*DENSITY", density]

    def _inertias(self) -> None:
        first = max(self.mesh.elements, default=0) + len(self.ties.stubs) + 2
        for place, (origin, node, value) in enumerate(self.ties.inertias):
            name = f"MODETUNE_INERTIA_{place + 1}"
            self.add(f"*ELEMENT, TYPE=MASS, ELSET={name}", origin)
            self.add(f"{first + place}, {node}", origin)
            self.add(f"*MASS, ELSET={name}", origin)
            self.add(format_number(value), origin)
            self.add("*BOUNDARY", origin)
            self.add(f"{node}, 2, 3", origin)

    def _tie(self, scope: Scope, card: KeywordCard) -> None:
        if not card.is_one_of("*TIE"):
            return
        known = {"NAME", "ADJUST", "TYPE", "POSITIONTOLERANCE", "NOROTATION", "NOTHICKNESS"}
        refuse_options(self.deck, card, known)
        options = {"NAME": self.name(scope, card.option("NAME") or "TIE", card)}
        if card.option("POSITIONTOLERANCE"):
            options["POSITION TOLERANCE"] = card.option("POSITIONTOLERANCE")
        if card.option("ADJUST") == "NO":
            options["ADJUST"] = "NO"
        for line in card.data:
            names = [self.name(scope, canonical_name(t), card) for t in self.deck.fields(line) if t]
            self.header(card, "*TIE", **options)
            self.add(", ".join(names[:2]), line)

    def _boundary(self, scope: Scope, card: KeywordCard) -> None:
        """Supports, by what ccx has of each component."""
        refuse_options(self.deck, card, {"OP", "TYPE", "AMPLITUDE"})
        if card.option("TYPE") not in ("", "DISPLACEMENT"):
            text = f"*BOUNDARY, TYPE={card.option('TYPE')} is not translated"
            raise ModelError(f"{self.deck.where(card)}: {text}")
        options = {"OP": card.option("OP")} if card.option("OP") else {}
        self.header(card, "*BOUNDARY", **options)
        for line in card.data:
            where, fields = self.deck.lines[line].where, self.deck.fields(line)
            first, last, value = [*map(canonical_name, fields[1:]), "", "", ""][:3]
            if first in CONDITIONS:
                components, value = CONDITIONS[first], ""
            elif first.isdecimal() and (last or first).isdecimal() and len(first + last) < 3:
                components = tuple(range(int(first), int(last or first) + 1))
            else:
                raise ModelError(f"{where}: {fields[0]} is held by {first or 'nothing'}, which is "
                                 "not translated")  # fmt: skip
            for node in self.mesh.node_set(scope, fields[0], where):
                for component in components:
                    if freedom := self.ties.freedom(node, component):
                        self._hold(freedom, node, component, value, line)

    def _hold(
        self, freedom: tuple[int, int], node: int, component: int, value: str, line: int
    ) -> None:
        if freedom in self.ties.dependent:
            other = self.deck.lines[self.ties.dependent[freedom]].where
            text = f"component {component} of {self.mesh.labels[node]} is held"
            raise ModelError(f"{self.deck.lines[line].where}: {text} and follows from {other}")
        self.add(
            f"{freedom[0]}, {freedom[1]}, {freedom[1]}" + (f", {value}" if value else ""), line
        )

    def _steps(self) -> None:
        """The step of the modes, and the static ones before it for load cases."""
        step: list[KeywordCard] = []
        wanted = self.deck.step or bool(frequency_steps(self.deck))
        modal = modal_step(self.deck, read_steps(self.deck)) if wanted else None
        for card in self.mesh.others:
            if not self._in_step(card):
                continue
            step = [card] if card.is_one_of("*STEP") else [*step, card]
            if card.is_one_of("*END STEP"):
                kinds = {item.keyword for item in step}
                if modal is not None and step[0].lines.start == modal.start:
                    self._frequency(step)
                    return
                if "*STATIC" in kinds:
                    self._static(step)

    def _frequency(self, step: Sequence[KeywordCard]) -> None:
        self.header(step[0], "*STEP")
        for card in step[1:]:
            if card.is_one_of("*FREQUENCY"):
                self.header(card, "*FREQUENCY")
                fields = self.deck.fields(card.data[0]) if card.data else []
                given = [fields[0] if fields and fields[0].isdecimal() else "10", *fields[1:3]]
                while not given[-1]:
                    given.pop()
                self.add(", ".join(given), card.data[0] if card.data else card.lines.start)
        for card in step[1:]:
            if card.is_one_of("*BOUNDARY"):
                self._boundary(self.mesh.scopes[""], card)
            elif not card.is_one_of("*FREQUENCY") and card.keyword not in IDLE:
                text = f"{card.keyword} in the frequency step is not translated"
                raise ModelError(f"{self.deck.where(card)}: {text}")
        self.add("*END STEP", step[-1].lines.start)

    def _static(self, step: Sequence[KeywordCard]) -> None:
        where = self.deck.where(step[0])
        if step[0].option("NLGEOM") == "YES" or (
            "NLGEOM" in step[0].options and not step[0].option("NLGEOM")
        ):
            name = step[0].option("NAME")
            raise ModelError(f"{where}: step {name} has loads and NLGEOM, whose stresses are "
                             "not translated")  # fmt: skip
        self.header(step[0], "*STEP")
        self.add("*STATIC", step[0].lines.start)
        for card in step[1:]:
            if card.is_one_of("*BOUNDARY"):
                if "PERTURBATION" in step[0].options:
                    raise ModelError(f"{self.deck.where(card)}: supports of a perturbation step, "
                                     "of this step alone, are not translated")  # fmt: skip
                self._boundary(self.mesh.scopes[""], card)
            elif card.is_one_of("*CLOAD"):
                self._forces(card)
            elif card.is_one_of("*DLOAD"):
                self._gravity(card)
            elif not card.is_one_of("*STATIC") and card.keyword not in IDLE:
                raise ModelError(f"{self.deck.where(card)}: {card.keyword} is not translated")
        self.add("*END STEP", step[-1].lines.start)

    def _forces(self, card: KeywordCard) -> None:
        refuse_options(self.deck, card, {"OP"})
        self.header(card, "*CLOAD", **({"OP": card.option("OP")} if card.option("OP") else {}))
        for line in card.data:
            name, component, value, *_ = [*self.deck.fields(line), "", ""]
            where = self.deck.lines[line].where
            for node in self.mesh.node_set(self.mesh.scopes[""], name, where):
                number = int(component) if component in tuple("123456") else 0
                freedom = self.ties.freedom(node, number) if number else None
                if freedom is None:
                    raise ModelError(f"{where}: {name} has no component {component}")
                self.add(f"{freedom[0]}, {freedom[1]}, {value}", line)

    def _gravity(self, card: KeywordCard) -> None:
        refuse_options(self.deck, card, {"OP"})
        for line in card.data:
            name, kind, *rest = [*self.deck.fields(line), "", ""]
            if kind.upper() != "GRAV" or not name:
                text = f"*DLOAD {kind} on {name or 'the whole model'} is not translated"
                raise ModelError(f"{self.deck.lines[line].where}: {text}")
            self.header(card, "*DLOAD")
            own = self.name(self.mesh.scopes[""], canonical_name(name), card)
            self.add(", ".join([own, "GRAV", *(word for word in rest if word)]), line)
