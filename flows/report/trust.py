"""The report's section on how far the updated parameters can be trusted."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from modetune.core.judgement import trust_sentences
from modetune.core.record import CampaignRecord
from modetune.core.trust import Trust
from modetune.flows.localisation.form_verdict import record_verdict
from modetune.flows.report.markup import (
    Html,
    bullets,
    element,
    folded,
    joined,
    number,
    paragraph,
    percent,
    table,
)
from modetune.flows.report.palette import AFTER, TEST

#: How each verdict looks.
MOOD = {"trusted": "good", "trusted with reservations": "fair", "not to be trusted": "outside"}


def trust_words(record: CampaignRecord) -> Html:
    """The verdict with its reasons, a line each parameter, and the numbers behind them."""
    trust = record.trust
    if trust is None:
        return Html("")
    verdict, *more = trust_sentences(trust)
    found = trust.identifiability
    numbers = (
        "Singular values of the weighted sensitivity (standard deviations of the test by which one "
        "deviation of a combination of parameters moves it; below 1 the test knows less than was "
        f"known beforehand): {', '.join(number(value, '.3g') for value in found.singular_values)}; "
        f"condition {number(found.condition, '.3g')}; collinearity index of all parameters "
        f"{number(found.collinearity.whole, '.3g')}."
    )
    parts = [
        element("p", element("span", verdict, MOOD[trust.verdict]), "lead"),
        bullets(more, "remarks") if more else Html(""),
        _model_form(record),
        _parameters(trust),
        paragraph(
            "Share of the test: 100 % is the test alone, 0 % what the campaign took for granted "
            "beforehand (bounds aside).", "note",
        ),
        paragraph(numbers, "note"),
    ]  # fmt: skip
    return joined(parts) + _starts(record, trust)


def _model_form(record: CampaignRecord) -> Html:
    """Whether what is left of the residual is noise, or a fault that no parameter stands for."""
    found, trust = record_verdict(record), record.trust
    if found is None or (trust and found.sentence in (*trust.concerns, *trust.notes)):
        return Html("")
    mood = "outside" if found.form.suspected else "note"
    return element("p", element("span", found.sentence, mood))


def _parameters(trust: Trust) -> Html:
    lines: list[list[Html | str]] = []
    for item in trust.parameters:
        share = percent(item.test_share, 0, sign=False)
        lines.append([
            item.name,
            element("span", share, "outside") if item.doubtful else share,
            f"±{number(item.standard_error, '.2g')}" if np.isfinite(item.standard_error)
            else "not known",
            item.sentence,
        ])  # fmt: skip
    return table(("parameter", "share of the test", "standard error", "what is to be said"),
                 lines, (0, 3))  # fmt: skip


def _starts(record: CampaignRecord, trust: Trust) -> Html:
    """Where the updates from several starts ended."""
    spread = trust.spread
    if spread is None:
        return Html("")
    lines: list[list[Html | str]] = []
    for start, outcome in enumerate(spread.outcomes):
        place = int(spread.minima[start])
        lines.append([
            f"{start + 1}{' (the answer)' if start == spread.chosen else ''}",
            "" if place < 0 else str(place + 1),
            number(float(spread.misfits[start]), ".4g"),
            *(number(float(value), ".4f") for value in spread.updated[start]),
            outcome,
        ])  # fmt: skip
    headings = ("start", "place", "weighted misfit", *record.parameters.names, "how it ended")
    return folded(
        f"Updates from {len(spread.outcomes)} starts (seed {spread.seed})",
        table(headings, lines, (0, len(headings) - 1)),
    )


def l_curve_chart(trust: Trust) -> go.Figure:
    """Size of the step over what it leaves, for all factors; the corner and the factor taken."""
    curve = trust.curve
    assert curve is not None
    figure = go.Figure()
    figure.add_scatter(
        x=curve.misfits, y=curve.sizes, mode="lines", name="all factors", customdata=curve.factors,
        line={"color": "#8a8f98"},
        hovertemplate="factor %{customdata:.3g}: left %{x:.3g}, size %{y:.3g}<extra></extra>",
    )  # fmt: skip
    points = [("corner", curve.corner, TEST, "circle-open")]
    if trust.regularisation > 0.0:
        points.append(("taken", trust.regularisation, AFTER, "x-thin"))
    for name, factor, colour, symbol in points:
        place = int(np.argmin(np.abs(np.log(curve.factors / factor))))
        figure.add_scatter(
            x=[curve.misfits[place]], y=[curve.sizes[place]], mode="markers",
            name=f"{name}: {factor:.3g}",
            marker={"color": colour, "size": 11, "symbol": symbol,
                    "line": {"color": colour, "width": 2.5}},
            hovertemplate="%{fullData.name}<extra></extra>",
        )  # fmt: skip
    figure.update_xaxes(title_text="residual left, in standard deviations", type="log")
    figure.update_yaxes(title_text="size of the step, in deviations", type="log")
    figure.update_layout(height=340, margin={"l": 56, "r": 8, "t": 12, "b": 46})
    return figure
