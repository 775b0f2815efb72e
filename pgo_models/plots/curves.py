"""Pictures of curves: the share of graphs that is certified over the noise, and quantities that decay."""

from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import COLOURS, MARKERS, column_figure, count_along_x

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_MARKERS = 15
_LONG_LABEL = 25  # letters: two of them do not fit beside each other


def plot_tightness(curves: list[tuple[str, Array, Array]]) -> "Figure":
    """Figure of how many graphs are certified at which rotation noise.

    Every curve is a label, the noise in radians, (levels,), and the certified share there, (levels,), in [0, 1].
    """
    with column_figure(height=0.75) as figure:
        axes = figure.add_subplot()
        styles = zip(cycle(COLOURS), cycle(MARKERS), strict=True)
        for (label, rotation_std, fraction), (colour, marker) in zip(curves, styles, strict=False):
            axes.plot(np.rad2deg(rotation_std), 100.0 * fraction, color=colour, marker=marker, label=label)
        axes.set_xlabel("rotation noise, standard deviation (degrees)")
        axes.set_ylabel("graphs certified (%)")
        axes.set_ylim(-5, 105)
        axes.legend()
    return figure


def plot_decay(curves: list[tuple[str, Array]], quantity: str) -> "Figure":
    """Figure of positive quantities over the iterations, on a logarithmic axis; `quantity` is what they are, with unit.

    Every curve is a label and its values from iterate 0 on.
    """
    longest = max((len(label) for label, _ in curves), default=0)
    with column_figure(height=0.8) as figure:
        axes = figure.add_subplot()
        styles = zip(cycle(COLOURS), cycle(MARKERS), strict=True)
        for (label, values), (colour, marker) in zip(curves, styles, strict=False):
            every = max(1, len(values) // _MOST_MARKERS)
            axes.semilogy(np.arange(len(values)), values, color=colour, marker=marker, markevery=every, label=label)
        axes.set_xlabel("iteration")
        count_along_x(axes)
        axes.set_ylabel(quantity)
        figure.legend(loc="outside upper center", ncols=1 if longest > _LONG_LABEL else 2)
    return figure
