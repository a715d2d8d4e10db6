"""Expanded shapes as files: for ParaView, as modes that other commands read, and in a figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modetune.adapters.test_files.measurements import check_out, write_modes
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import MeasuredModes
from modetune.core.storage.files import check_writable
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.units import METRES
from modetune.flows.report.chart import PARAMETER_COLOURS, Axis, Bars, Chart, Panel, names_of
from modetune.flows.studies.expand.expansion import ExpandedShapes, Expansions

#: The series in its folder.
SERIES = "expanded"


def check_files(campaign: Campaign, out: Path | None, paraview: Path | None) -> None:
    """Refuse what cannot be written before the work is done. Raises CampaignError."""
    if out is not None:
        check_out(out)
    if paraview is not None:
        from modetune.adapters.paraview import check_series

        if not campaign.case.solver.deck.mesh().cells:
            raise CampaignError(
                f"{campaign.file}: a model of the solver {campaign.solver_name} has no elements, "
                "so there is nothing to show in ParaView; leave --paraview out"
            )
        check_writable(paraview, "name another place with --paraview")
        check_series(paraview, SERIES)


def write_files(
    campaign: Campaign, found: Expansions, out: Path | None, paraview: Path | None
) -> list[Path]:
    """Write what was asked for of the chosen method. Raises StorageUnavailable."""
    written: list[Path] = []
    modes, mesh = found.chosen.modes, found.chosen.mesh
    assert modes is not None
    assert mesh is not None
    if out is not None:
        nodes = np.flatnonzero(np.isin(mesh.nodes, modes.nodes))
        points = TestGeometry(
            nodes=mesh.nodes[nodes],
            coordinates=mesh.coordinates[nodes],
            frames=np.array(
                [mesh.frames.get(node, np.eye(3)) for node in mesh.nodes[nodes].tolist()]
            ).reshape(-1, 3, 3),
            metres=METRES[campaign.case.units],
        )
        said = (f"modetune expand: {found.sentence}",)
        write_modes(out, MeasuredModes(found.numbers, modes), points if nodes.size else None, said)
        written.append(out)
    if paraview is not None:
        from modetune.adapters.paraview import mode_grids, write_series

        grids = mode_grids(mesh, modes)
        written.append(write_series(paraview, SERIES, grids, modes.frequencies_hz))
    return written


def error_chart(found: Expansions) -> Chart:
    """The error at held-out sensors of each mode by each method."""
    shown: list[ExpandedShapes] = [item for item in found.methods if not item.unavailable]
    bars = tuple(
        Bars(item.method, 100.0 * item.held_out, colour)
        for item, colour in zip(shown, PARAMETER_COLOURS, strict=False)
    )
    panel = Panel(bars, Axis("mode of the test", names_of(found.numbers)), Axis("error, %"))
    title = f"{found.name}: error of expanded shapes at held-out sensors"
    return Chart(title, title, (panel,))
