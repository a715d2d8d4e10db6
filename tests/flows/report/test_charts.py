"""A chart is described once: both drawings show what it says, and take no text for markup."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from modetune.core.storage.record import CampaignRecord
from modetune.flows.report.chart import Axis, Bars, Chart, Curve, HeatMap, Panel, Rule
from modetune.flows.report.charts import campaign_charts
from modetune.flows.report.matplotlib_charts import matplotlib_figure
from modetune.flows.report.plotly_charts import plotly_figure

STRANGE = "$x_$ <b>"


def two_panels() -> Chart:
    x = np.array([1.0, 2.0, 3.0])
    curve = Curve("before", x, 10.0**x, "#56B4E9", "-", "o", told=("one", "two", "<i>three"))
    bars = Bars("before", np.array([1.0, -2.0]), "#56B4E9")
    return Chart(
        STRANGE,
        "a test",
        (
            Panel((curve, Rule(STRANGE, 50.0)), Axis("x"), Axis("y", log=True)),
            Panel((bars,), Axis("%"), Axis(names=("first", STRANGE), turned=True), sideways=True),
        ),
        across=2,
    )


def test_both_drawings_show_every_panel_and_its_axes() -> None:
    chart = two_panels()
    print_, page = matplotlib_figure(chart), plotly_figure(chart)
    left, right = print_.axes
    assert left.get_yscale() == page.layout.yaxis.type == "log"
    np.testing.assert_array_equal(left.lines[0].get_ydata(), page.data[0].y)
    assert (
        [bar.get_width() for bar in right.patches if isinstance(bar, Rectangle)]
        == list(page.data[1].x)
        == [1.0, -2.0]
    )
    assert right.yaxis_inverted()
    assert page.layout.yaxis2.range[0] > page.layout.yaxis2.range[1]


def test_a_name_of_several_panels_stands_in_the_legend_once() -> None:
    chart = two_panels()
    (legend,) = matplotlib_figure(chart).legends
    assert [text.get_text() for text in legend.get_texts()] == ["before", r"\$x_\$ <b>"]
    shown = [item.showlegend for item in plotly_figure(chart).data]
    assert shown == [True, False]


def test_texts_are_taken_neither_for_markup_nor_for_formulas() -> None:
    chart = two_panels()
    page = plotly_figure(chart)
    assert page.data[0].hovertext[2] == "&lt;i&gt;three"
    assert page.layout.yaxis2.ticktext[1] == "$x_$ &lt;b&gt;"
    names = [text.get_text() for text in matplotlib_figure(chart).axes[1].get_yticklabels()]
    assert names[1] == r"\$x_\$ <b>"


@pytest.mark.parametrize(("n", "numbered"), [(4, True), (40, False)])
def test_values_are_written_into_a_map_while_there_is_room(n: int, numbered: bool) -> None:
    names = tuple(map(str, range(n)))
    heat = HeatMap(np.eye(n), "{row} with {column}: {value:.1f}", "MAC")
    chart = Chart("map", "", (Panel((heat,), Axis(names=names), Axis(names=names)),))
    # Zeros are left out in print: a field of them hides what is to be seen.
    assert len(matplotlib_figure(chart).axes[0].texts) == (n if numbered else 0)
    drawn = plotly_figure(chart).data[0]
    assert (drawn.texttemplate is not None) == numbered
    assert drawn.hovertext[1][2] == "1 with 2: 0.0"


def test_every_chart_of_a_campaign_is_drawn_by_both(record: CampaignRecord) -> None:
    charts = dict(campaign_charts(replace(record, name=STRANGE)))
    for name, chart in charts.items():
        figure = matplotlib_figure(chart)
        assert len(figure.axes) >= len(chart.panels), name
        assert plotly_figure(chart.alone(0)).data, name


def test_errors_of_frequencies_are_those_of_the_record(record: CampaignRecord) -> None:
    chart = dict(campaign_charts(record))["frequencies"]
    before, after = chart.panels[1].items
    assert isinstance(before, Bars)
    assert isinstance(after, Bars)
    # The plate's modes are made 5 % off at first and 0.1 % at last.
    np.testing.assert_allclose(before.values, 5.0)
    np.testing.assert_allclose(after.values, 0.1)
