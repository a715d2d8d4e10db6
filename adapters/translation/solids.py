"""Nastran solids as CalculiX C3D elements.

CHEXA with eight nodes becomes C3D8I, which bends as Nastran's does, and not C3D8, which locks.
Both number the corners alike; the midside nodes of the upper face and of the uprights have another
order.
"""

from __future__ import annotations

from typing import Any

from modetune.adapters.translation.assembly import Assembly
from modetune.adapters.translation.calculix_text import CalculixText, number_list

#: A given shear modulus this close to E / 2 (1 + nu) is the isotropic one with rounded digits.
SAME_SHEAR = 5e-3


#: ccx kind by Nastran's kind and number of nodes.
KIND = {
    ("CHEXA", 8): "C3D8I", ("CHEXA", 20): "C3D20", ("CPENTA", 6): "C3D6", ("CPENTA", 15): "C3D15",
    ("CTETRA", 4): "C3D4", ("CTETRA", 10): "C3D10", ("CPYRAM", 5): "C3D8", ("CPYRAM", 13): "C3D20",
}  # fmt: skip
KINDS = ("CHEXA", "CPENTA", "CTETRA", "CPYRAM")
#: Nastran goes lower face, uprights, upper face; ccx lower face, upper face, uprights.
ORDER = {
    "C3D20": (*range(12), 16, 17, 18, 19, 12, 13, 14, 15),
    "C3D15": (*range(9), 12, 13, 14, 9, 10, 11),
}
#: A pyramid is a brick whose upper face is one point, by its number of nodes.
PYRAMIDS = {
    5: (0, 1, 2, 3, *(4,) * 4),
    13: (0, 1, 2, 3, *(4,) * 4, 5, 6, 7, 8, *(4,) * 4, *range(9, 13)),
}


def translate_solids(model: Assembly) -> None:
    """Add all solids of the model; those whose masses are lumped have no density."""
    builder = model.builder
    names: dict[int, str] = {}
    for element in model.elements(*KINDS):
        if element.pid not in names:
            factor = 0.0 if element.pid in model.lumped_properties else model.wtmass
            names[element.pid] = _material(element.pid_ref, builder, model.problems, factor)
        nodes = list(element.node_ids)
        while nodes and nodes[-1] is None:
            nodes.pop()
        kind = KIND.get((element.type, len(nodes)))
        if kind is None or None in nodes:
            model.refuse(element, "some of its midside nodes are missing")
            continue
        if names[element.pid]:
            order = ORDER.get(kind, tuple(range(len(nodes))))
            if element.type == "CPYRAM":
                order = PYRAMIDS[len(nodes)]
            sets = (*model.sets_of(element), f"V{element.pid}")
            builder.new_element(kind, [nodes[place] for place in order], sets)
    for pid, material in names.items():
        if material and f"V{pid}" in builder.sets:
            builder.section([f"*SOLID SECTION, ELSET=V{pid}, MATERIAL={material}"])


def _material(card: Any, builder: CalculixText, problems: list[str], wtmass: float) -> str:
    """Add the material of a PSOLID (isotropic MAT1 only), one for each density it is used with.

    Returns its name, empty after a problem.
    """
    if card.type != "PSOLID":
        problems.append(f"{card.type} {card.pid}: solids are translated with PSOLID only")
        return ""
    if card.fctn not in (None, "SMECH"):
        problems.append(f"PSOLID {card.pid}: FCTN={card.fctn} is not a structural solid")
        return ""
    material = card.mid_ref
    if material.type != "MAT1":
        problems.append(f"{material.type} {material.mid}: solids are translated with MAT1 only")
        return ""
    e, g, nu, density = material.e, material.g, material.nu, material.rho * wtmass
    if not e or not g or not abs(2.0 * g * (1.0 + nu) / e - 1.0) < SAME_SHEAR:
        problems.append(
            f"MAT1 {material.mid}: E={e}, G={g} and NU={nu} are not an isotropic solid; "
            "leave one of them blank"
        )
        return ""
    lines = ["*ELASTIC", number_list((e, nu))]
    if density:
        lines += ["*DENSITY", number_list((density,))]
    name, count = f"M{material.mid}", 1
    while not builder.can_be_material(name, lines):
        count += 1
        name = f"M{material.mid}_{count}"
    builder.material(name, lines)
    return name
