"""A number of a model that an expression of parameters gives, with its exact derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from modetune.core.expressions import evaluate, names_of, slopes
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter


@dataclass(frozen=True, slots=True)
class Relation:
    """constant + slope * expression.

    columns: of the parameters that the expression names, in its order; origins, scales: of the
    users' values in terms of the relative ones.
    """

    expression: str
    columns: tuple[int, ...]
    origins: tuple[float, ...]
    scales: tuple[float, ...]
    constant: float = 0.0
    slope: float = 1.0

    @classmethod
    def of(
        cls, expression: str, parameters: Sequence[Parameter], constant: float, slope: float
    ) -> Relation:
        """Return a relation to free parameters, all that the expression names among them."""
        names = [item.name for item in parameters]
        columns = tuple(names.index(name) for name in names_of(expression))
        origins, scales = (
            tuple(getattr(parameters[column], field) for column in columns)
            for field in ("origin", "scale")
        )
        return cls(expression, columns, origins, scales, constant, slope)

    def at(self, theta: Floats) -> float:
        """Return the number at relative values (n_parameters,). Raises ModelError."""
        return self.constant + self.slope * evaluate(self.expression, self._values(theta))

    def change(self, theta: Floats, column: int, order: int = 1) -> float:
        """Return its derivative of order 1 or 2 with respect to a column. Raises ModelError."""
        if column not in self.columns:
            return 0.0
        place = self.columns.index(column)
        name = names_of(self.expression)[place]
        found = slopes(self.expression, self._values(theta), name)[order - 1]
        return self.slope * found * self.scales[place] ** order

    def _values(self, theta: Floats) -> dict[str, float]:
        items = zip(names_of(self.expression), self.columns, self.origins, self.scales, strict=True)
        return {name: origin + scale * float(theta[c]) for name, c, origin, scale in items}
