"""Mode shapes of test and model at the test's sensors, for people and for Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, common_dofs, dof_name
from modetune.core.near_names import suggestion
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.report.chart import AFTER, BEFORE, TEST, Axis, Chart, Curve, Panel, positions
from modetune.flows.report.comparison import scaled_test
from modetune.flows.report.mode_tables import mode_rows

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, repr=False)
class ModeShapes:
    """Shapes of the test's modes and of their partners in the model, before and after updating.

    modes: labels (n_modes,) of the test's modes. dofs: names (n_dof,), such as "12.z". test,
    initial, updated: (n_dof, n_modes), the test's of unit length and the model's scaled to them.
    mac_initial, mac_updated: (n_modes,).
    """

    name: str
    modes: tuple[str, ...]
    dofs: tuple[str, ...]
    test: Floats
    initial: Floats
    updated: Floats
    mac_initial: Floats
    mac_updated: Floats

    def plot(self, *modes: str | int) -> Figure:
        """Shapes over the sensors, of these modes or of all. Raises ModesError."""
        from modetune.flows.report.matplotlib_charts import matplotlib_figure

        return matplotlib_figure(self.chart(modes))

    def chart(self, modes: Sequence[str | int] = ()) -> Chart:
        """Return a chart of these modes, or of all. Raises ModesError."""
        panels = tuple(
            Panel(
                tuple(
                    Curve(name, positions(self.dofs), shapes[:, mode], colour, width=width)
                    for name, shapes, colour, width in (
                        ("test", self.test, TEST, 2.6), ("before", self.initial, BEFORE, 1.5),
                        ("after", self.updated, AFTER, 1.5),
                    )
                ),
                Axis(names=self.dofs, slant=90), title=f"mode {self.modes[mode]}",
            )
            for mode in self._places(modes)
        )  # fmt: skip
        return Chart(self.name, "shapes over the sensors", panels, min(3, len(panels)), (3.6, 2.4))

    @property
    def frame(self) -> pd.DataFrame:
        """A row a degree of freedom: columns are mode, and test, initial or updated."""
        import pandas as pd

        sides = {"test": self.test, "initial": self.initial, "updated": self.updated}
        columns = {
            (label, side): shapes[:, place]
            for place, label in enumerate(self.modes)
            for side, shapes in sides.items()
        }
        found = pd.DataFrame(columns, pd.Index(self.dofs, name="dof"))
        return found.rename_axis(columns=["mode", "shape"])

    def _places(self, modes: Sequence[str | int]) -> list[int]:
        unknown = [str(mode) for mode in modes if str(mode) not in self.modes]
        if unknown:
            raise ModesError(
                f"{self.name}: there is no paired mode {unknown[0]}"
                f"{suggestion(unknown[0], self.modes)} (there are: {', '.join(self.modes)})"
            )
        return [self.modes.index(str(mode)) for mode in modes] or list(range(len(self.modes)))

    def __repr__(self) -> str:
        return (
            f"ModeShapes({self.name}: {len(self.modes)} modes at {len(self.dofs)} degrees of "
            f"freedom, MAC at least {self.mac_updated.min():.3f})"
        )


def mode_shapes(record: CampaignRecord) -> ModeShapes:
    """Return the shapes of a record. Raises ModesError without measured shapes."""
    if not record.test.has_shapes:
        raise ModesError(f"{record.name}: the test has no shapes")
    first, last = record.iterations[0], record.best
    test, before = scaled_test(record, first)
    rows, _ = common_dofs(record.test.modes, first.computed)
    modes = record.test.modes
    named = zip(modes.nodes[rows].tolist(), modes.components[rows].tolist(), strict=True)
    return ModeShapes(
        record.name,
        tuple(row.label for row in mode_rows(record)),
        tuple(map(dof_name, named)),
        test,
        before,
        scaled_test(record, last)[1],
        np.array(first.pairing.mac),
        np.array(last.pairing.mac),
    )
