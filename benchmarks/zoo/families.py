"""All families of structures by name."""

from __future__ import annotations

from collections.abc import Callable

from benchmarks.zoo.frames import grillage, stick, tower
from benchmarks.zoo.matrix_models import assembly, chain, mechanism, polar_masses
from benchmarks.zoo.several_minima import (
    far_frame,
    mirrored_beam,
    sectors,
    series_springs,
    soil_building,
)
from benchmarks.zoo.shells import laminate, stiffened_plate, tube
from benchmarks.zoo.solids import bracket, round_bar, soft_mounts, square_bar, string
from benchmarks.zoo.structure import Generator, Structure

FAMILIES: dict[str, Callable[[Generator], Structure]] = {
    made.__name__: made
    for made in (
        square_bar,
        round_bar,
        tube,
        laminate,
        stiffened_plate,
        bracket,
        tower,
        grillage,
        soft_mounts,
        string,
        stick,
        chain,
        mechanism,
        polar_masses,
        assembly,
        sectors,
        mirrored_beam,
        soil_building,
        series_springs,
        far_frame,
    )
}
