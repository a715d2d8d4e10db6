"""Cross-sections of Nastran bars, beams and rods as the few numbers that beam theory needs.

y and z are the element's axes; plane 1 is x-y. I1 is the integral of y^2, I2 that of z^2. PBARL and
PBEAML give dimensions; thin-walled ones are made of rectangles, each (centre y, centre z, size y,
size z), a hole's with a negative area. Torsion constants: Roark's for a rectangle, Bredt's for a
closed wall, the sum of b t^3 / 3 for open walls. Shear factors are Cowper's simple values where
Nastran's manual has them and none (no shear strain, as for a blank K1, K2) elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Rectangle = tuple[float, float, float, float]
#: Ends of a beam this alike differ by rounded digits; the mean is taken.
SAME = 1e-3


@dataclass(frozen=True, slots=True)
class CrossSection:
    """shear_1, shear_2: factors on the area for shear in planes 1 and 2, 0 for no shear strain.

    mass_per_length: structural and not; turning_1, turning_2: mass moments per length that belong
    to I1 and I2 (rho I). is_rod: carries nothing but tension and torsion. All of the deck's units,
    without WTMASS.
    """

    area: float
    inertia_1: float
    inertia_2: float
    inertia_12: float
    torsion: float
    shear_1: float
    shear_2: float
    youngs_modulus: float
    shear_modulus: float
    density: float
    nonstructural_mass: float
    is_rod: bool = False

    @property
    def mass_per_length(self) -> float:
        return self.density * self.area + self.nonstructural_mass


@dataclass(frozen=True, slots=True)
class SectionShape:
    """area, inertia_1, inertia_2, inertia_12, torsion, shear factors of a set of dimensions.

    is_centred: whether shear centre and centroid are one.
    """

    area: float
    inertia_1: float
    inertia_2: float
    inertia_12: float
    torsion: float
    shear_1: float = 0.0
    shear_2: float = 0.0
    is_centred: bool = True


def cross_section(card: Any) -> CrossSection:
    """The cross-section of a property card, or of a CONROD. Raises ValueError with the reason."""
    readers: dict[str, Callable[[Any], CrossSection]] = {
        "PBAR": _pbar,
        "PBARL": _pbarl,
        "PBEAM": _pbeam,
        "PBEAML": _pbeaml,
        "PROD": _prod,
        "CONROD": _prod,
        "PTUBE": _ptube,
    }
    if card.type not in readers:
        raise ValueError(f"{card.type} is not translated")
    return readers[card.type](card)


def shape_of(kind: str, dimensions: Sequence[float]) -> SectionShape:
    """The numbers of a PBARL or PBEAML type. Raises ValueError for a type that is not known."""
    if kind not in _SHAPES:
        raise ValueError(f"cross-section {kind} is not translated; give it as PBAR or PBEAM")
    try:
        shape = _SHAPES[kind](*dimensions)
    except (ZeroDivisionError, TypeError) as error:
        raise ValueError(f"cross-section {kind} with {list(dimensions)}: {error}") from error
    if min(shape.area, shape.inertia_1, shape.inertia_2) <= 0.0:
        raise ValueError(f"cross-section {kind} with {list(dimensions)} encloses no area")
    return shape


def _made(
    card: Any, material: Any, shape: SectionShape, extra: float, is_rod: bool = False
) -> CrossSection:
    if material is None or material.type != "MAT1":
        raise ValueError("its material is not a MAT1")
    if not material.e:
        raise ValueError(f"MAT1 {material.mid} has no E")
    return CrossSection(
        float(shape.area),
        float(shape.inertia_1),
        float(shape.inertia_2),
        float(shape.inertia_12),
        float(shape.torsion),
        float(shape.shear_1),
        float(shape.shear_2),
        float(material.e),
        float(material.g or 0.0),
        float(material.rho or 0.0),
        float(extra or 0.0),
        is_rod,
    )


def _pbar(card: Any) -> CrossSection:
    shape = SectionShape(
        card.A, card.i1, card.i2, card.i12 or 0.0, card.j or 0.0, card.k1 or 0.0, card.k2 or 0.0
    )
    return _made(card, card.mid_ref, shape, card.nsm)


def _pbarl(card: Any) -> CrossSection:
    return _made(card, card.mid_ref, shape_of(card.beam_type, card.dim), card.nsm)


def _pbeam(card: Any) -> CrossSection:
    names = ("A", "i1", "i2", "i12", "j", "nsm")
    values = [_constant(getattr(card, name), name.upper()) for name in names]
    for name in ("n1a", "n1b", "n2a", "n2b"):
        if getattr(card, name):
            raise ValueError(
                f"a neutral axis off the shear centre ({name.upper()}) is not translated"
            )
    for name in ("m1a", "m1b", "m2a", "m2b", "nsia", "nsib"):
        if getattr(card, name):
            raise ValueError(
                f"non-structural mass with an offset or inertia ({name.upper()}) is not translated"
            )
    for name in ("cwa", "cwb"):
        if getattr(card, name):
            raise ValueError(f"warping ({name.upper()}) is not translated")
    area, i1, i2, i12, torsion, extra = values
    shape = SectionShape(area, i1, i2, i12, torsion, card.k1 or 0.0, card.k2 or 0.0)
    return _made(card, card.mid_ref, shape, extra)


def _pbeaml(card: Any) -> CrossSection:
    for values in zip(*card.dim, strict=True):
        _constant(values, "DIM")
    extra = _constant(card.nsm, "NSM")
    shape = shape_of(card.beam_type, card.dim[0])
    if not shape.is_centred:
        raise ValueError(
            f"a {card.beam_type}, whose shear centre is off its centroid, is not translated"
        )
    return _made(card, card.mid_ref, shape, extra)


def _constant(values: Sequence[float], name: str) -> float:
    """The one value along the beam: a tapered beam has the stiffness of no uniform one."""
    if any(abs(value - values[0]) > SAME * abs(values[0]) for value in values):
        raise ValueError(f"a taper ({name} changes along the beam) is not translated")
    return float(sum(values) / len(values))


def _prod(card: Any) -> CrossSection:
    shape = SectionShape(card.A, 0.0, 0.0, 0.0, card.j or 0.0)
    return _made(card, card.mid_ref, shape, card.nsm, is_rod=True)


def _ptube(card: Any) -> CrossSection:
    if card.OD2 is not None and abs(card.OD2 - card.OD1) > 1e-6 * card.OD1:
        raise ValueError("a taper (OD2 is not OD1) is not translated")
    outer = card.OD1 / 2.0
    tube = _ring(outer, outer - card.t if card.t else 0.0)
    return _made(card, card.mid_ref, tube, card.nsm, is_rod=True)


def _ring(outer: float, inner: float) -> SectionShape:
    area = math.pi * (outer**2 - inner**2)
    second = math.pi / 4.0 * (outer**4 - inner**4)
    shear = 0.5 if inner else 0.9
    return SectionShape(area, second, second, 0.0, 2.0 * second, shear, shear)


def _bar(width: float, height: float) -> SectionShape:
    """width along z, height along y."""
    long, short = max(width, height), min(width, height)
    ratio = short / long
    torsion = long * short**3 * (1.0 / 3.0 - 0.21 * ratio * (1.0 - ratio**4 / 12.0))
    area = width * height
    return SectionShape(
        area, area * height**2 / 12.0, area * width**2 / 12.0, 0.0, torsion, 5.0 / 6.0, 5.0 / 6.0
    )


def _box(width: float, height: float, flange: float, wall: float) -> SectionShape:
    return _box1(width, height, flange, flange, wall, wall)


def _box1(
    width: float, height: float, top: float, bottom: float, left: float, right: float
) -> SectionShape:
    inner_y, inner_z = height - top - bottom, width - left - right
    hole = ((bottom - top) / 2.0, (left - right) / 2.0, inner_y, -inner_z)
    shape = _rectangles([(0.0, 0.0, height, width), hole])
    across, up = width - (left + right) / 2.0, height - (top + bottom) / 2.0
    torsion = 4.0 * (across * up) ** 2 / (across / top + across / bottom + up / left + up / right)
    is_centred = top == bottom and left == right
    return SectionShape(
        shape.area,
        shape.inertia_1,
        shape.inertia_2,
        0.0,
        torsion,
        (left + right) * height / shape.area,
        (top + bottom) * width / shape.area,
        is_centred,
    )


def _rectangles(parts: Sequence[Rectangle], is_centred: bool = True) -> SectionShape:
    """Area and moments about the common centroid; torsion as of open walls."""
    area = sum(a * b for _, _, a, b in parts)
    centre_y = sum(y * a * b for y, _, a, b in parts) / area
    centre_z = sum(z * a * b for _, z, a, b in parts) / area
    i1 = sum(a * b * (a * a / 12.0 + (y - centre_y) ** 2) for y, _, a, b in parts)
    i2 = sum(a * b * (b * b / 12.0 + (z - centre_z) ** 2) for _, z, a, b in parts)
    i12 = sum(a * b * (y - centre_y) * (z - centre_z) for y, z, a, b in parts)
    torsion = sum(max(abs(a), abs(b)) * min(abs(a), abs(b)) ** 3 / 3.0 for _, _, a, b in parts)
    scale = math.sqrt(abs(i1 * i2))
    return SectionShape(
        area, i1, i2, 0.0 if abs(i12) < 1e-12 * scale else i12, torsion, is_centred=is_centred
    )


def _i(h: float, low: float, high: float, web: float, t_low: float, t_high: float) -> SectionShape:
    inner = h - t_low - t_high
    parts = [
        (t_low / 2.0, 0.0, t_low, low),
        (t_low + inner / 2.0, 0.0, inner, web),
        (h - t_high / 2.0, 0.0, t_high, high),
    ]
    is_centred = math.isclose(low, high) and math.isclose(t_low, t_high)
    made = _rectangles(parts, is_centred)
    return SectionShape(
        made.area,
        made.inertia_1,
        made.inertia_2,
        0.0,
        made.torsion,
        web * h / made.area,
        5.0 / 6.0 * (low * t_low + high * t_high) / made.area,
        is_centred,
    )


def _i1(overhang: float, web: float, inner: float, height: float) -> SectionShape:
    flange = (height - inner) / 2.0
    return _i(height, overhang + web, overhang + web, web, flange, flange)


def _h(inner: float, legs: float, height: float, bar: float) -> SectionShape:
    arm = (inner + legs / 2.0) / 2.0
    leg = legs / 2.0
    return _rectangles([(0.0, 0.0, bar, inner), (0.0, arm, height, leg), (0.0, -arm, height, leg)])


def _cross(arms: float, web: float, height: float, bar: float) -> SectionShape:
    arm = (arms / 2.0 + web) / 2.0
    half = arms / 2.0
    return _rectangles([(0.0, 0.0, height, web), (0.0, arm, bar, half), (0.0, -arm, bar, half)])


def _t(width: float, height: float, flange: float, web: float) -> SectionShape:
    stem = height - flange
    return _rectangles([(0.0, 0.0, flange, width), (-height / 2.0, 0.0, stem, web)], False)


def _t1(height: float, stem: float, flange: float, web: float) -> SectionShape:
    return _rectangles([(0.0, 0.0, height, flange), (0.0, (flange + stem) / 2.0, web, stem)], False)


def _l(width: float, height: float, foot: float, leg: float) -> SectionShape:
    """foot: thickness of the horizontal leg; leg: that of the vertical one."""
    upright = height - foot
    lying = (0.0, (width - leg) / 2.0, foot, width)
    return _rectangles([lying, (height / 2.0, 0.0, upright, leg)], False)


def _chan(width: float, height: float, web: float, flange: float) -> SectionShape:
    return _chan1(width - web, web, height - 2.0 * flange, height)


def _chan1(overhang: float, web: float, inner: float, height: float) -> SectionShape:
    flange = (height - inner) / 2.0
    arm, up = (overhang + web) / 2.0, (inner + flange) / 2.0
    sides = [(sign * up, arm, flange, overhang) for sign in (1.0, -1.0)]
    return _rectangles([(0.0, 0.0, height, web), *sides], False)


def _chan2(leg: float, flange: float, height: float, width: float) -> SectionShape:
    arm, up = (width - leg) / 2.0, (height - flange) / 2.0
    legs = [(up + flange / 2.0, sign * arm, height - flange, leg) for sign in (1.0, -1.0)]
    return _rectangles([(0.0, 0.0, flange, width), *legs], False)


def _z(overhang: float, web: float, inner: float, height: float) -> SectionShape:
    flange = (height - inner) / 2.0
    arm, up = (overhang + web) / 2.0, (inner + flange) / 2.0
    ends = [(up, arm, flange, overhang), (-up, -arm, flange, overhang)]
    return _rectangles([(0.0, 0.0, height, web), *ends])


_SHAPES: dict[str, Callable[..., SectionShape]] = {
    "ROD": lambda radius: _ring(radius, 0.0),
    "TUBE": _ring,
    "TUBE2": lambda outer, thickness: _ring(outer, outer - thickness),
    "BAR": _bar, "BOX": _box, "BOX1": _box1, "I": _i, "I1": _i1, "H": _h, "CROSS": _cross,
    "T": _t, "T1": _t1, "T2": _t, "L": _l, "CHAN": _chan, "CHAN1": _chan1, "CHAN2": _chan2,
    "Z": _z,
}  # fmt: skip
