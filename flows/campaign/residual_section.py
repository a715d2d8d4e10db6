"""What is compared, and how exactly it was measured: the campaign's `residuals`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from modetune.flows.campaign.section import NotNegative, Positive, Section

#: Stands for the modes that a key does not name.
OTHERS = "others"
#: What a key of modes stands for.
ModeKey = Literal["frequency_weight", "shape_weight", "frequency_deviation", "shape_deviation"]
SensorKey = Literal["sensor_weight", "sensor_deviation"]


def _by_name(given: object) -> object:
    """A mapping with names as text, as the file's lines go by them."""
    return {str(key): value for key, value in given.items()} if isinstance(given, dict) else given


def _by_mode(given: object) -> object:
    """The same; one value goes for all modes."""
    return _by_name(given) if isinstance(given, dict) else {OTHERS: given}


#: One value, or values by a mode's number and of the `others`.
Weights = Annotated[
    dict[str, NotNegative],
    BeforeValidator(_by_mode, json_schema_input_type=NotNegative | dict[str, NotNegative]),
]
Deviations = Annotated[
    dict[str, Positive],
    BeforeValidator(_by_mode, json_schema_input_type=Positive | dict[str, Positive]),
]


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
    sensor_weight: Annotated[dict[str, NotNegative], BeforeValidator(_by_name)] = Field(default={})
    """Emphasis of sensors by name, `12.z`, or all of a point, `12`; 1 unless given. 0 leaves a
    sensor out altogether, as if it had not been there."""
    sensor_deviation: Annotated[dict[str, Positive], BeforeValidator(_by_name)] = Field(default={})
    """Standard deviation of sensors by name, where it is another than `shape_deviation`; 1 unless
    given [of the shape's deviation]"""

    @property
    def with_shapes(self) -> bool:
        """Whether shapes of some modes may be compared."""
        return any(value > 0.0 for value in self.shape_weight.values())

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
