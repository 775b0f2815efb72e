"""What all matplotlib figures share: widths of columns, sizes of letters, colours, and saving."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from pgo_models.errors import MissingExtraError, extra_module
from pgo_models.files import replace_when_done

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMN_INCHES = 3.4  # a column of a two-column paper
LETTER_POINTS = 8.0  # of titles and labels, as of the captions of such a paper
SMALL_POINTS = 7.0  # of ticks and legends
DOTS_PER_INCH = 200  # of a .png
PICTURE_SUFFIXES = (".png", ".svg", ".pdf")

# Okabe & Ito 2008: readers with any of the common colour blindnesses can distinguish them.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#000000")
# Methods may be more than these colours: Tol's muted ones are added.
METHOD_COLOURS = (*COLOURS, "#882255", "#999933", "#661100", "#44AA99")
ALARM_COLOUR = "#D55E00"  # vermilion, kept for what is wrong
QUIET_COLOUR = "#999999"
MARKERS = ("o", "s", "D", "^", "v", "P")


@contextmanager
def column_figure(height: float, width: float = 1.0) -> Iterator[Figure]:
    """Yield a figure in the project's style, whose width and height are in columns of a paper."""
    matplotlib = extra_module("matplotlib", "plot")
    settings = {
        "font.size": LETTER_POINTS,
        "axes.titlesize": LETTER_POINTS,
        "axes.labelsize": LETTER_POINTS,
        "legend.fontsize": SMALL_POINTS,
        "xtick.labelsize": SMALL_POINTS,
        "ytick.labelsize": SMALL_POINTS,
        "lines.linewidth": 1.2,
        "lines.markersize": 3.5,
        "axes.grid": False,
    }
    size = (COLUMN_INCHES * width, COLUMN_INCHES * height)
    with matplotlib.rc_context(settings):
        figure = _shown_figure()(figsize=size, layout="constrained")
        yield figure
        for axes in figure.axes:
            # Otherwise matplotlib chooses the size of the tick labels when the figure is shown.
            axes.tick_params(which="both", labelsize=SMALL_POINTS)


def plotly(name: str) -> ModuleType:
    """Module of plotly, whose import waits until something is drawn."""
    return extra_module(f"plotly.{name}", "plot")


def count_along_x(axes: Axes) -> None:
    """Put ticks of the x axis at whole numbers alone, for things that are counted."""
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def is_picture(path: Path) -> bool:
    """Whether the suffix names a picture format that `save_figure` writes."""
    return path.suffix.lower() in PICTURE_SUFFIXES


def check_installed(path: Path) -> None:
    """Raise a MissingExtraError unless the library that draws a file of this suffix is installed.

    Matplotlib draws pictures, and plotly all other files, which are pages.
    """
    module = "matplotlib" if is_picture(path) else "plotly"
    if importlib.util.find_spec(module) is None:
        raise MissingExtraError(module, "plot")


def save_figure(figure: Figure, path: Path | str) -> None:
    """Write a figure as .png, .svg or .pdf, whole or not at all; errors as `replace_when_done`."""
    path = Path(path)
    with replace_when_done(path) as temporary:
        figure.savefig(temporary, format=path.suffix.lower().lstrip("."), dpi=DOTS_PER_INCH)


@cache
def _shown_figure() -> type[Figure]:
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        """Figure that a notebook shows by itself, without pyplot and its global state."""

        def _repr_png_(self) -> bytes:
            png = BytesIO()
            self.savefig(png, format="png", dpi=DOTS_PER_INCH)
            return png.getvalue()

    return ShownFigure
