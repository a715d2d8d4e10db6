"""Responses that a campaign compares, with weights and deviations: its `residuals`.

Frequencies and shapes have their keys directly below `residuals`, every other response type has a
section. Weights and deviations go by the test's own names: a name that the test does not have, or
whose value would have no effect, is refused with its line and the nearest existing name.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from inspect import cleandoc
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

import numpy as np
from pydantic import BeforeValidator, Field, create_model

from modetune.adapters.solver import Deck, Solver
from modetune.adapters.yaml_file import YamlFile
from modetune.core.measurement.measurement import Measurement
from modetune.core.modes import Floats, MeasuredModes, ModeSet, dof_name
from modetune.core.near_names import suggestion
from modetune.core.updating.parameter_steps import StepForm
from modetune.core.updating.responses.response import Response
from modetune.core.updating.weighting import Weighting
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

#: Keys by mode, and by sensor.
ModeKey = Literal["frequency_weight", "shape_weight", "frequency_deviation", "shape_deviation"]
SensorKey = Literal["sensor_weight", "sensor_deviation"]
#: Keys by mode in the order of the fields of a weighting.
WEIGHTING: tuple[ModeKey, ...] = (
    "frequency_deviation", "shape_deviation", "frequency_weight", "shape_weight",
)  # fmt: skip
#: The response types besides frequencies and shapes, in the order of their rows: the file of this
#: folder, whose name is the type's key below `residuals`, and the section in it.
TYPES = (
    "mac:MacSection",
    "modal_strain:ModalStrainSection",
    "static:StaticSection",
    "damping:DampingSection",
    "complex_shapes:ComplexSection",
    "mass_properties:MassSection",
    "frf:FrfSection",
)
#: Those that compare shapes, or contain them.
COMPARE_SHAPES = {"mac", "complex_shapes", "frf"}
Keys = TypeVar("Keys", bound=Section)


def response_types() -> dict[str, type[ResponseSection]]:
    """Return the section of each response type by its key."""
    return {entry.partition(":")[0]: resolve_name(f"{__package__}.{entry}") for entry in TYPES}


def with_types(section: type[Keys]) -> type[Keys]:
    """Return a section with a key for each response type after its own keys."""
    keys: dict[str, Any] = {
        key: (found | None, Field(default=None, description=cleandoc(found.__doc__ or "")))
        for key, found in response_types().items()
    }
    name, module, meaning = section.__name__, section.__module__, section.__doc__
    return create_model(name, __base__=section, __module__=module, __doc__=meaning, **keys)


@with_types
class ResidualSection(Section):
    """Responses to compare: weights and deviations of frequencies and shapes, and the other
    response types.

    One value applies to all modes; `{1: 10, 2: 10, others: 1}` gives values by the test's mode
    numbers.
    """

    frequency_weight: Weights = Field(default=1.0, validate_default=True)
    """Weight of frequencies, one for all modes or by mode; 0 leaves them out."""
    shape_weight: Weights | None = Field(default=None)
    """Weight of mode shapes, one for all modes or by mode; 0 leaves them out. Without it 1 where
    shapes are measured and frequencies compared, unless `mac`, `complex_shapes` or `frf` compares
    shapes, or `update.step` or `sensitivity.method` is for frequencies alone."""
    frequency_deviation: Deviations = Field(default=0.002, validate_default=True)
    """Standard deviation of measured frequencies, one for all modes or by mode; without it the
    test's own, if its file or repetitions give them [of the frequency]"""
    shape_deviation: Deviations = Field(default=0.05, validate_default=True)
    """Standard deviation of measured shape entries, one for all modes or by mode; without it the
    test's own, if its file or repetitions give them [of the shape's rms]"""
    sensor_weight: Annotated[dict[str, NotNegative], BeforeValidator(by_name)] = Field(default={})
    """Weight of sensors by name, `12.z`, or of all at a point, `12`; 1 by default. 0 removes a
    sensor from the test altogether."""
    sensor_deviation: Annotated[dict[str, Positive], BeforeValidator(by_name)] = Field(default={})
    """Standard deviation of sensors by name, if it differs from `shape_deviation`; 1 by default [of
    the shape's deviation]"""

    @property
    def kinds(self) -> dict[str, ResponseSection]:
        """The sections of the response types that are compared besides frequencies and shapes."""
        return {key: section for key, section in self if isinstance(section, ResponseSection)}

    @property
    def shape_changes(self) -> bool:
        """Whether derivatives of shapes are needed."""
        return self.with_shapes or any(item.shape_changes for item in self.kinds.values())

    @property
    def functions(self) -> bool:
        """Whether response functions are compared."""
        return any(item.functions for item in self.kinds.values())

    @property
    def variables(self) -> set[str]:
        """Names of the `variable` parameters that the response types refer to."""
        return {name for item in self.kinds.values() for name in item.variables}

    def nodes(self, deck: Deck) -> tuple[int, ...]:
        """Return the nodes where shapes are needed besides those of the sensors."""
        return tuple({node for item in self.kinds.values() for node in item.nodes(deck)})

    def responses(self, given: TestedModel) -> tuple[Response, ...]:
        """Return the responses of these types for a test and a model."""
        return tuple(section.response(given) for section in self.kinds.values())

    def problems(self, source: YamlFile, given: TestedModel, solver: Solver) -> list[str]:
        """Return why these types do not fit a test and a model, each with file and line."""
        found = []
        for kind, section in self.kinds.items():
            texts = list(section.problems(given))
            if "matrices" in section.response(given).needs:
                if not solver.program.capabilities.matrices:
                    name = solver.program.name
                    needs = "gives no matrices, which it requires; run the deck on CalculiX or "
                    texts.append(((), f"{name} {needs}MYSTRAN (`model.solver`), or leave it out"))
                elif solver.deck.preload():
                    texts.append(((), f"{solver.deck.preload()}: the stiffness depends on a state"))
            found += [
                f"{source.where(('residuals', kind, *place))}: residuals.{kind}: {text}"
                for place, text in texts
            ]
        return found

    def warnings(self, source: YamlFile, given: TestedModel) -> list[str]:
        """Return the parts of the test that are not compared, each with file and line."""
        return [
            f"{source.where(('residuals', kind))}: {text}"
            for kind, section in self.kinds.items()
            for text in section.warnings(given)
        ]

    def with_default(self, has_shapes: bool) -> Self:
        """Return the section with the weight of shapes that it leaves open.

        has_shapes: whether the test has shapes, and updating can compare them.
        """
        if self.shape_weight is not None:
            return self
        compared = has_shapes and any({OTHERS: 1.0, **self.frequency_weight}.values())
        compared = compared and not COMPARE_SHAPES & set(self.kinds)
        return self.model_copy(update={"shape_weight": {OTHERS: float(compared)}})

    @property
    def by_mode(self) -> Iterator[tuple[tuple[str, ...], Mapping[str, float]]]:
        """Everything that is given by mode: its keys below `residuals`, and the values."""
        yield from (((key,), getattr(self, key) or {}) for key in get_args(ModeKey))
        for kind, section in self.kinds.items():
            yield from (((kind, key), getattr(section, key)) for key in section.mode_keys)

    @property
    def with_shapes(self) -> bool:
        """Whether shapes of some modes may be compared."""
        own = {} if self.shape_weight is None else {OTHERS: 1.0} | self.shape_weight
        weights = [own, *(section.shape_weights for section in self.kinds.values())]
        return any(value > 0.0 for item in weights for value in item.values())

    def of_mode(self, key: ModeKey, number: int, of_test: float | None = None) -> float:
        """Return a key's value for one mode; of_test: the test's, None where it has none."""
        given: dict[str, float] = getattr(self, key) or {}
        if str(number) in given:
            return given[str(number)]
        if of_test is None or (key in self.model_fields_set and OTHERS in given):
            return self.of_others(key)
        return of_test

    def of_others(self, key: ModeKey) -> float:
        """Return a key's value for the modes that it does not list."""
        given: dict[str, float] = getattr(self, key) or {}
        default: float | None = type(self).model_fields[key].default
        return given.get(OTHERS, 1.0 if default is None else default)


#: Steps without weights (thesis (34), (45)).
UNWEIGHTED = ("pseudo_inverse", "minimum_norm")


def weighting_of(
    section: ResidualSection, measurement: Measurement, test: MeasuredModes
) -> Weighting:
    """Return the weighting of a test's modes at their sensors.

    Deviations that the campaign does not give may come from the test, and with those of frequencies
    their correlation.
    """
    modes, known = measurement.modes, measurement.deviations
    of_test: dict[str, Floats] = {}
    correlation = np.zeros((0, 0))
    if modes is not None and known is not None:
        rows = [modes.numbers.index(number) for number in test.numbers]
        of_test["frequency_deviation"] = known.frequencies[rows]
        of_test["shape_deviation"] = known.shapes[rows]
        if known.correlation is not None:
            own = [section.of_mode("frequency_deviation", n, math.nan) for n in test.numbers]
            by_test = np.outer(np.isnan(own), np.isnan(own))
            correlation = np.where(by_test, known.correlation[np.ix_(rows, rows)], 0.0)
            np.fill_diagonal(correlation, 1.0)
    by_mode = []
    for key in WEIGHTING:
        found = of_test.get(key, np.full(len(test.numbers), np.nan)).tolist()
        values = [value if math.isfinite(value) else None for value in found]
        pairs = zip(test.numbers, values, strict=True)
        by_mode.append(np.array([section.of_mode(key, *pair) for pair in pairs]))
    by_sensor = (
        _by_sensor(values, test.modes)
        for values in (section.sensor_deviation, section.sensor_weight)
    )
    return replace(Weighting(*by_mode, *by_sensor), frequency_correlation=correlation)


def kept_sensors(section: ResidualSection, test: MeasuredModes) -> MeasuredModes:
    """Return the test without the sensors of weight 0."""
    kept = np.flatnonzero(_by_sensor(section.sensor_weight, test.modes) > 0.0)
    if kept.size == test.modes.n_dof:
        return test
    return MeasuredModes(test.numbers, test.modes.rows(kept))


def weight_problems(
    source: YamlFile,
    section: ResidualSection,
    step: StepForm,
    measurement: Measurement,
    used: Sequence[int],
    held_out: Sequence[int],
) -> list[str]:
    """Return why the `residuals` do not fit the test. used, held_out: numbers of its modes."""
    test = measurement.modes
    assert test is not None
    found = []
    for keys, values in section.by_mode:
        judged = (*used, *held_out) if keys == ("frequency_deviation",) else used
        for name in values:
            text = "" if name == OTHERS else _mode_problem(name, test.numbers, judged)
            if text:
                where = source.where(("residuals", *keys, name))
                found.append(f"{where}: residuals.{'.'.join(keys)}: {text}")
    for key in get_args(SensorKey):
        found += [
            f"{source.where(('residuals', key, name))}: residuals.{key}: {text}"
            for name in getattr(section, key)
            if (text := _sensor_problem(name, test))
        ]
    return found or _idle(source, section, step, measurement, test.use(tuple(used)))


def _mode_problem(name: str, numbers: Sequence[int], judged: Sequence[int]) -> str:
    has = ", ".join(map(str, numbers))
    if not name.isdecimal():
        return f"{name!r} is neither the number of a mode ({has}) nor `{OTHERS}`"
    if int(name) not in numbers:
        near = min(numbers, key=lambda number: abs(number - int(name)))
        return f"the test has no mode {name}; the nearest is {near} (it has {has})"
    if int(name) not in judged:
        return f"mode {name} is not used, so this has no effect; use the mode or leave this out"
    return ""


def _sensor_problem(name: str, test: MeasuredModes) -> str:
    names = _sensor_names(test.modes)
    if not names:
        return "the test has only frequencies, no sensors"
    if name in names or name in {item.partition(".")[0] for item in names}:
        return ""
    return f"the test has no sensor {name}{suggestion(name, names)}"


def _idle(
    source: YamlFile,
    section: ResidualSection,
    step: StepForm,
    measurement: Measurement,
    test: MeasuredModes,
) -> list[str]:
    """Return problems of weights that leave nothing to compare, or that have no effect."""
    where = source.where(("residuals",))
    section = section.with_default(test.has_shapes and step not in UNWEIGHTED)
    weighting = weighting_of(section, measurement, test)
    weights = np.concatenate([weighting.frequency_weights, weighting.shape_weights])
    if not weights.any() and not any(kind.counts for kind in section.kinds.values()):
        return [f"{where}: residuals: all weights are 0; one must be above zero"]
    found = []
    if test.has_shapes and not weighting.sensor_weights.any():
        place = source.where(("residuals", "sensor_weight"))
        found.append(f"{place}: residuals.sensor_weight leaves out every sensor of the test")
    counted = [name for name, weight in section.sensor_weight.items() if weight > 0.0]
    if counted and not section.with_shapes:
        found.append(
            f"{source.where(('residuals', 'sensor_weight', counted[0]))}: residuals.sensor_weight: "
            f"{counted[0]} has a weight, but no shapes are compared; give `shape_weight`"
        )
    if step in UNWEIGHTED:
        found += [
            f"{source.where(('residuals', kind))}: residuals.{kind}: `step: {step}` ignores "
            "deviations, which are needed to combine this with frequencies; use trust_region, "
            "weighted_least_squares or regularised"
            for kind in section.kinds
        ]
    if step in UNWEIGHTED and np.unique(weights[weights > 0.0]).size > 1:
        found.append(
            f"{where}: residuals: `step: {step}` ignores weights other than 0, but they differ; "
            "use weighted_least_squares or regularised, or one weight for all"
        )
    return found


def _by_sensor(given: Mapping[str, float], modes: ModeSet) -> Floats:
    """Return the values of the sensors (n_dof,): the sensor's, that of its point, or 1."""
    return np.array(
        [given.get(name, given.get(name.partition(".")[0], 1.0)) for name in _sensor_names(modes)]
    )


def _sensor_names(modes: ModeSet) -> list[str]:
    return [
        dof_name(dof) for dof in zip(modes.nodes.tolist(), modes.components.tolist(), strict=True)
    ]
