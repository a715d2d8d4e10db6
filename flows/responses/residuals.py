"""What is compared, and how exactly it was measured: the campaign's `residuals`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal, get_args

from pydantic import BeforeValidator, Field

from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import YamlFile
from modetune.core.updating.responses.response import Response
from modetune.flows.responses.complex_shapes import ComplexSection
from modetune.flows.responses.damping import DampingSection
from modetune.flows.responses.frf import FrfSection
from modetune.flows.responses.mac import MacSection
from modetune.flows.responses.mass_properties import MassSection
from modetune.flows.responses.modal_strain import ModalStrainSection
from modetune.flows.responses.response import ResponseSection, TestedModel
from modetune.flows.responses.section import (
    OTHERS,
    Deviations,
    NotNegative,
    Positive,
    Section,
    Weights,
    by_name,
)
from modetune.flows.responses.static import StaticSection

#: What a key of modes stands for.
ModeKey = Literal["frequency_weight", "shape_weight", "frequency_deviation", "shape_deviation"]
SensorKey = Literal["sensor_weight", "sensor_deviation"]


#: Keys of the kinds of responses beside frequencies and shapes, in the order of their rows.
KINDS = (
    "mac", "modal_strain", "static", "damping", "complex_shapes", "mass_properties", "frf",
)  # fmt: skip


class ResidualSection(Section):
    """What is compared: emphasis of frequencies and shapes, and how exactly they were measured.

    One value goes for all modes; `{1: 10, 2: 10, others: 1}` is by the test's numbers.
    """

    frequency_weight: Weights = Field(default=1.0, validate_default=True)
    """Emphasis of frequencies, of all or by mode; 0 leaves them out."""
    shape_weight: Weights = Field(default=0.0, validate_default=True)
    """Emphasis of mode shapes, of all or by mode; 0 leaves them out."""
    frequency_deviation: Deviations = Field(default=0.002, validate_default=True)
    """Standard deviation of measured frequencies, of all or by mode; without it those of the
    test, where its file or repetitions tell them [of the frequency]"""
    shape_deviation: Deviations = Field(default=0.05, validate_default=True)
    """Standard deviation of measured shape entries, of all or by mode; without it those of the
    test, where its file or repetitions tell them [of the shape's rms]"""
    sensor_weight: Annotated[dict[str, NotNegative], BeforeValidator(by_name)] = Field(default={})
    """Emphasis of sensors by name, `12.z`, or all of a point, `12`; 1 unless given. 0 leaves a
    sensor out altogether, as if it had not been there."""
    sensor_deviation: Annotated[dict[str, Positive], BeforeValidator(by_name)] = Field(default={})
    """Standard deviation of sensors by name, where it is another than `shape_deviation`; 1 unless
    given [of the shape's deviation]"""
    mac: MacSection | None = None
    """MAC as a response of its own."""
    modal_strain: ModalStrainSection | None = None
    """Strains of modes at gauges."""
    static: StaticSection | None = None
    """Static displacements and strains under load cases."""
    damping: DampingSection | None = None
    """Modal damping ratios."""
    complex_shapes: ComplexSection | None = None
    """Complex measured shapes beside those of the damped model."""
    mass_properties: MassSection | None = None
    """Mass, centre of gravity and inertia as targets and as limits."""
    frf: FrfSection | None = None
    """Response functions of the test's files."""

    @property
    def kinds(self) -> dict[str, ResponseSection]:
        """The sections of the kinds that are compared beside frequencies and shapes."""
        found = ((key, getattr(self, key)) for key in KINDS)
        return {key: section for key, section in found if section is not None}

    def responses(self, given: TestedModel) -> tuple[Response, ...]:
        """These kinds as a test and a model have them."""
        return tuple(section.response(given) for section in self.kinds.values())

    def problems(self, source: YamlFile, given: TestedModel, solver: Solver) -> list[str]:
        """Why these kinds do not fit a test and a model, each with file and line."""
        found = []
        for kind, section in self.kinds.items():
            said = list(section.problems(given))
            if "matrices" in section.response(given).needs:
                if not solver.program.capabilities.matrices:
                    name = solver.program.name
                    needs = "gives no matrices, which it requires; run the deck on CalculiX or "
                    said.append(((), f"{name} {needs}MYSTRAN (`model.solver`), or leave it out"))
                elif solver.deck.preload():
                    said.append(((), f"{solver.deck.preload()}: the stiffness depends on a state"))
            found += [
                f"{source.where(('residuals', kind, *place))}: residuals.{kind}: {text}"
                for place, text in said
            ]
        return found

    @property
    def by_mode(self) -> Iterator[tuple[tuple[str, ...], Mapping[str, float]]]:
        """All that is given by mode: its keys below `residuals`, and the values."""
        yield from (((key,), getattr(self, key)) for key in get_args(ModeKey))
        for kind, section in self.kinds.items():
            yield from (((kind, key), getattr(section, key)) for key in section.mode_keys)

    @property
    def with_shapes(self) -> bool:
        """Whether shapes of some modes may be compared."""
        weights = [self.shape_weight, *(section.shape_weights for section in self.kinds.values())]
        return any(value > 0.0 for item in weights for value in item.values())

    def of_mode(self, key: ModeKey, number: int, told: float | None = None) -> float:
        """A key's value for one mode; told: by the test file."""
        given: dict[str, float] = getattr(self, key)
        if str(number) in given:
            return given[str(number)]
        if told is None or (key in self.model_fields_set and OTHERS in given):
            return self.of_others(key)
        return told

    def of_others(self, key: ModeKey) -> float:
        """A key's value for the modes that it does not name."""
        given: dict[str, float] = getattr(self, key)
        default: float = type(self).model_fields[key].default
        return given.get(OTHERS, default)
