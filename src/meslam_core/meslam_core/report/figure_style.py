"""How the report's figures look, and how they get into the page."""

from __future__ import annotations

import functools
import html
import io
import itertools
import re
from collections.abc import Callable
from typing import Any, ParamSpec

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import NDArray

# Colours that the page replaces by its own, so that figures follow light and dark.
INK, GRID = "#010203", "#020304"
_THEME = {INK: "currentColor", GRID: "var(--line)"}

# Okabe and Ito, *Color universal design*, 2008, in an order of distinct lightness.
RUN_COLORS = ("#1a80c4", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#8c8c8c")
STAGE_COLORS = {
    "reading": "#8c8c8c",
    "odometry": "#e69f00",
    "tracking": "#0072b2",
    "mapping": "#56b4e9",
}
TRUTH_COLOR = "#8c8c8c"
MOST_POINTS = 600
# Width of a figure across the page and of one in a run's panel [in].
WIDE, NARROW = 12.5, 5.6

_STYLE: Any = {
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "meslam",
    "text.parse_math": False,
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GRID,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": GRID,
    "ytick.color": GRID,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
}
_numbers = itertools.count()

Arguments = ParamSpec("Arguments")
Floats = NDArray[np.floating]


def drawn(
    description: str,
) -> Callable[[Callable[Arguments, Figure]], Callable[Arguments, Markup]]:
    """Turns a function that draws a figure into one that returns it as inline SVG.

    Args:
        description: of the figure, for who cannot see it.
    """

    def decorate(draw: Callable[Arguments, Figure]) -> Callable[Arguments, Markup]:
        @functools.wraps(draw)
        def draw_svg(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Markup:
            with matplotlib.rc_context(_STYLE):
                return _inline_svg(draw(*args, **kwargs), description)

        return draw_svg

    return decorate


def run_color(number: int) -> str:
    """The colour of a run by its place in the report."""
    return RUN_COLORS[number % len(RUN_COLORS)]


def run_line(number: int) -> str:
    """The line style of a run: another one each time the colours begin anew."""
    return ("-", "--", ":")[number // len(RUN_COLORS) % 3]


def thinned(
    x: Floats, y: Floats, limit: int = MOST_POINTS
) -> tuple[Floats, Floats, Floats, Floats]:
    """At most `limit` points of a curve: places, medians, least and largest values there."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if len(x) <= limit:
        return x, y, y, y
    parts = [
        slice(a, b) for a, b in itertools.pairwise(np.linspace(0, len(x), limit + 1, dtype=int))
    ]
    places, middle, low, high = (
        np.array([function(values[part]) for part in parts])
        for function, values in ((np.median, x), (np.median, y), (np.min, y), (np.max, y))
    )
    return places, middle, low, high


def _inline_svg(figure: Figure, description: str) -> Markup:
    """A figure as an SVG element without references to anything outside of it."""
    FigureCanvasSVG(figure)
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=nothing)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    # Names of parts must differ between the figures of a page.
    prefix = f"f{next(_numbers)}-"
    text = re.sub(r'(<g) id="[^"]*"', r"\1", text)
    text = re.sub(r'( id="|url\(#|href="#)', rf"\g<1>{prefix}", text)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text)
    text = re.sub(r"(font: [^'\";]*?px) [^\";]*", r"\1 system-ui, sans-serif", text)
    for color, replacement in _THEME.items():
        text = text.replace(color, replacement)
    label = f'role="img" aria-label="{html.escape(description)}"'
    text = re.sub(r'(<svg [^>]*?)width="[^"]*"', rf"\1{label}", text, count=1)
    text = re.sub(r'(<svg [^>]*?)height="[^"]*"', r"\1", text, count=1)
    # matplotlib has escaped every text in it.
    return Markup(text)
