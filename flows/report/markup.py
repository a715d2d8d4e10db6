"""Small pieces of HTML; every text that is not already markup is escaped."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

#: What stands for a number that is not known.
UNKNOWN = "\N{EN DASH}"
MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True, slots=True)
class Html:
    """Markup, as opposed to text: it goes into a page as it is."""

    source: str

    def __add__(self, other: Html) -> Html:
        return Html(self.source + other.source)


def markup(value: Html | str) -> str:
    """The source of markup, or a text escaped."""
    return value.source if isinstance(value, Html) else html.escape(value)


def joined(parts: Sequence[Html | str]) -> Html:
    return Html("".join(markup(part) for part in parts))


def element(name: str, content: Html | str, kind: str = "") -> Html:
    """An element with a class or without; name and class are our own, never a user's."""
    classes = f' class="{kind}"' if kind else ""
    return Html(f"<{name}{classes}>{markup(content)}</{name}>")


def paragraph(content: Html | str, kind: str = "") -> Html:
    return element("p", content, kind)


def bullets(items: Sequence[Html | str], kind: str = "") -> Html:
    return element("ul", joined([element("li", item) for item in items]), kind)


def table(
    headings: Sequence[str], rows: Sequence[Sequence[Html | str]], texts: Sequence[int] = (0,)
) -> Html:
    """A table; `texts` are the columns that hold words and stand to the left."""

    def cell(name: str, column: int, content: Html | str) -> Html:
        return element(name, content, "words" if column in texts else "")

    head = joined([cell("th", column, heading) for column, heading in enumerate(headings)])
    body = joined(
        [
            element("tr", joined([cell("td", column, item) for column, item in enumerate(row)]))
            for row in rows
        ]
    )
    inside = element("thead", element("tr", head)) + element("tbody", body)
    return element("div", element("table", inside), "table")


def folded(summary: str, content: Html, is_open: bool = False) -> Html:
    """Something that opens at a click."""
    state = " open" if is_open else ""
    return Html(f"<details{state}><summary>{markup(summary)}</summary>{content.source}</details>")


def code(text: str) -> Html:
    return Html(f"<pre><code>{html.escape(text)}</code></pre>")


def mono(text: str) -> Html:
    return element("code", text)


def chart_text(text: str) -> str:
    """A user's text in a chart, where a few tags would else be understood."""
    return html.escape(text, quote=False)


def hertz(value: float) -> str:
    """A frequency with five significant digits, three decimals at most."""
    if not math.isfinite(value):
        return UNKNOWN
    decimals = min(3, max(0, 4 - math.floor(math.log10(abs(value))))) if value else 3
    return f"{value:.{decimals}f}"


def percent(share: float, decimals: int = 2, sign: bool = True) -> str:
    """A share in percent; what rounds to nothing has no sign."""
    if not math.isfinite(share):
        return UNKNOWN
    shown = f"{100 * share:{'+' if sign else ''}.{decimals}f}"
    return f"{shown.replace('-', MINUS)} %" if float(shown) else f"{0:.{decimals}f} %"


def number(value: float, digits: str = ".4g") -> str:
    return f"{value:{digits}}".replace("-", MINUS) if math.isfinite(value) else UNKNOWN


def duration(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"
