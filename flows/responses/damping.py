"""Modal damping ratios as responses: the campaign's `residuals.damping`."""

from __future__ import annotations

from collections.abc import Iterator

from modetune.adapters.yaml_file import Place
from modetune.core.measurement.repeated_tests import damping_covariance
from modetune.core.updating.damped_pairs import DampedPairs
from modetune.core.updating.responses.damping import DampingRatios
from modetune.flows.responses.response import ModewiseSection, TestedModel
from modetune.flows.responses.section import Positive


class DampingSection(ModewiseSection):
    """Damping ratios of the paired modes, computed from the dampers of the model."""

    deviation: Positive = 0.1
    """Standard deviation of measured ratios; without it, that of repeated tests if there are any,
    with the correlation of their errors [of the ratio]"""
    tolerance: Positive = 0.2
    """Largest error that e1 accepts [of the measured ratio]"""

    def response(self, given: TestedModel) -> DampingRatios:
        weights = self.weights(given.test.numbers)
        own = weights, self.deviation, self.tolerance, DampedPairs(given.deck.damping)
        if given.repeats is None or "deviation" in self.model_fields_set:
            return DampingRatios(*own)
        return DampingRatios(*own, damping_covariance(given.repeats, given.test.numbers))

    def problems(self, given: TestedModel) -> Iterator[tuple[Place, str]]:
        ratios = given.test.modes.damping_ratios
        if not ratios.size:
            yield (), "the test has no damping ratios: leave this out"
            return
        weights = self.weights(given.test.numbers)
        for number, ratio in zip(given.test.numbers, ratios.tolist(), strict=True):
            if ratio <= 0.0 and weights[number]:
                text = f"mode {number} has the damping ratio {ratio:g}, which must be above zero"
                yield ("weight",), f"{text}: give it weight 0"
        if text := given.deck.undamped():
            yield (), text
