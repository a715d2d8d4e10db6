"""A chart is described once: print and page have what it says, and no text is markup."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.report.campaign_charts import campaign_charts
from modetune.flows.report.chart import Axis, Bars, Chart, Curve, HeatMap, Panel, Rule, chart_json
from modetune.flows.report.matplotlib_charts import matplotlib_figure

STRANGE = "$x_$ <b>"


def two_panels() -> Chart:
    x = np.array([1.0, 2.0, 3.0])
    curve = Curve("before", x, 10.0**x, "#56B4E9", "-", "o", tooltips=("one", "two", "<i>three"))
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


def told(chart: Chart) -> Any:
    """What a page's script reads."""
    return json.loads(json.dumps(chart_json(chart), allow_nan=False))


def test_print_and_page_have_every_panel_and_its_axes() -> None:
    chart = two_panels()
    left, right = matplotlib_figure(chart).axes
    first, second = told(chart)["panels"]
    assert left.get_yscale() == "log"
    assert first["y"]["log"] is True
    np.testing.assert_array_equal(left.lines[0].get_ydata(), first["items"][0]["y"])
    widths = [bar.get_width() for bar in right.patches if isinstance(bar, Rectangle)]
    assert widths == second["items"][0]["values"] == [1.0, -2.0]
    assert right.yaxis_inverted()
    assert second["y"]["turned"] is True
    assert second["sideways"] is True


def test_what_no_axis_can_show_is_null_and_numbers_have_six_digits() -> None:
    curve = Curve("", np.array([1.0, np.nan]), np.array([np.inf, 1 / 3]), "#000000")
    found = told(Chart("", "", (Panel((curve,)),)))["panels"][0]["items"][0]
    assert found["x"] == [1.0, None]
    assert found["y"] == [None, 0.333333]


def test_a_name_of_several_panels_stands_in_the_legend_once() -> None:
    (legend,) = matplotlib_figure(two_panels()).legends
    assert [text.get_text() for text in legend.get_texts()] == ["before", r"\$x_\$ <b>"]


def test_texts_are_not_taken_for_formulas_in_print_and_stay_as_they_are_for_the_page() -> None:
    chart = two_panels()
    names = [text.get_text() for text in matplotlib_figure(chart).axes[1].get_yticklabels()]
    assert names[1] == r"\$x_\$ <b>"
    first, second = told(chart)["panels"]
    assert first["items"][0]["tooltips"][2] == "<i>three"  # the page's script sets text, not markup
    assert second["y"]["names"][1] == STRANGE


@pytest.mark.parametrize(("n", "numbered"), [(4, True), (40, False)])
def test_values_are_written_into_a_map_while_there_is_room(n: int, numbered: bool) -> None:
    names = tuple(map(str, range(n)))
    heat = HeatMap(np.eye(n), "{row} with {column}: {value:.1f}", "MAC")
    chart = Chart("map", "", (Panel((heat,), Axis(names=names), Axis(names=names)),))
    # Zeros are left out in print: a field of them hides what is to be seen.
    assert len(matplotlib_figure(chart).axes[0].texts) == (n if numbered else 0)
    assert told(chart)["panels"][0]["items"][0]["numbered"] == numbered


def test_every_chart_of_a_campaign_is_for_print_and_page(record: CampaignRecord) -> None:
    charts = dict(campaign_charts(replace(record, name=STRANGE)))
    for name, chart in charts.items():
        figure = matplotlib_figure(chart)
        assert len(figure.axes) >= len(chart.panels), name
        assert len(told(chart)["panels"]) == len(chart.panels), name


def test_errors_of_frequencies_are_those_of_the_record(record: CampaignRecord) -> None:
    chart = dict(campaign_charts(record))["frequencies"]
    before, after = chart.panels[1].items
    assert isinstance(before, Bars)
    assert isinstance(after, Bars)
    # The plate's modes are made 5 % off at first and 0.1 % at last.
    np.testing.assert_allclose(before.values, 5.0)
    np.testing.assert_allclose(after.values, 0.1)
