"""Equations of the documentation as vector graphics, made while the site is built.

A page holds TeX between dollar signs, which GitHub shows too. Here matplotlib's own typesetter
turns each equation into one SVG path that takes the colour of the text around it: no script, no
font and no network are needed to read the site. An entry of `hooks` in mkdocs.yml.
"""

from __future__ import annotations

import html
import re

from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.textpath import TextPath, text_to_path
from mkdocs.exceptions import PluginError

#: Points of a drawn em; paths are rounded to whole ones.
EM = 100
#: How mkdocs leaves the equations of the Markdown extension `arithmatex`.
EQUATION = re.compile(
    r'<(span|div) class="arithmatex">\\[\[(]\s*(.*?)\s*\\[\])]</(?:span|div)>', re.DOTALL
)
LETTERS = {Path.MOVETO: "M", Path.LINETO: "L", Path.CURVE3: "Q", Path.CURVE4: "C"}


def on_page_content(content: str, page: object, **_: object) -> str:
    """The page with its equations drawn; mkdocs calls this. Raises PluginError."""

    def drawn(found: re.Match[str]) -> str:
        tag, tex = found[1], html.unescape(found[2])
        try:
            return f'<{tag} class="equation">{equation(tex)}</{tag}>'
        except ValueError as error:
            raise PluginError(f"{page}: the equation {tex!r} cannot be set: {error}") from error

    return EQUATION.sub(drawn, content)


def equation(tex: str) -> str:
    """An equation as an SVG element. Raises ValueError where it is not TeX that is understood."""
    text = f"${' '.join(tex.split())}$"
    font = FontProperties(size=EM, math_fontfamily="cm")
    width, height, descent = text_to_path.get_text_width_height_descent(text, font, True)
    path = TextPath((0, 0), text, prop=font)
    view = f"0 {descent - height:.0f} {width:.0f} {height:.0f}"
    size = f"width:{width / EM:.2f}em;height:{height / EM:.2f}em"
    message = html.escape(tex)
    return (
        f'<svg role="img" viewBox="{view}" style="{size};vertical-align:{-descent / EM:.2f}em">'
        f'<title>{message}</title><path fill="currentColor" d="{_drawn(path)}"/></svg>'
    )


def _drawn(path: Path) -> str:
    """SVG's letters for a path; its y axis points down."""
    parts = []
    for vertices, code in path.iter_segments(simplify=False):
        if code == Path.CLOSEPOLY:
            parts.append("Z")
            continue
        pairs = zip(vertices[::2], vertices[1::2], strict=True)
        parts.append(LETTERS[code] + " ".join(f"{x:.0f} {-y:.0f}" for x, y in pairs))
    return "".join(parts)
