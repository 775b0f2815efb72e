"""Figures of curves: the share of certified graphs over the noise, and quantities that decay."""

from collections.abc import Iterator
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.plots.style import COLOURS, MARKERS, column_figure, count_along_x

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_MARKERS = 15  # of a curve
_LONG_LABEL = 25  # letters: two labels of this length do not fit beside each other


def plot_tightness(curves: list[tuple[str, Array, Array]]) -> "Figure":
    """Figure of the share of graphs that are certified at every level of rotation noise.

    A curve is a label, the noise in radians, (levels,), and the certified share at these levels,
    (levels,), in [0, 1].
    """
    with column_figure(height=0.75) as figure:
        axes = figure.add_subplot()
        for (label, rotation_std, share), (colour, marker) in zip(curves, _styles(), strict=False):
            degrees = np.rad2deg(rotation_std)
            axes.plot(degrees, 100.0 * share, color=colour, marker=marker, label=label)
        axes.set_xlabel("rotation noise, standard deviation (degrees)")
        axes.set_ylabel("graphs certified (%)")
        axes.set_ylim(-5, 105)
        axes.legend()
    return figure


def plot_decay(curves: list[tuple[str, Array]], quantity: str) -> "Figure":
    """Figure of positive values over the iterations, on a logarithmic axis.

    A curve is a label and its values from iterate 0 on; `quantity` is the name of the values, with
    their unit.
    """
    lengths = [len(label) for label, _ in curves]
    longest_label = max(lengths, default=0)
    with column_figure(height=0.8) as figure:
        axes = figure.add_subplot()
        for (label, values), (colour, marker) in zip(curves, _styles(), strict=False):
            axes.semilogy(
                np.arange(len(values)),
                values,
                color=colour,
                marker=marker,
                markevery=max(1, len(values) // _MOST_MARKERS),
                label=label,
            )
        axes.set_xlabel("iteration")
        count_along_x(axes)
        axes.set_ylabel(quantity)
        num_columns = 1 if longest_label > _LONG_LABEL else 2
        figure.legend(loc="outside upper center", ncols=num_columns)
    return figure


def _styles() -> Iterator[tuple[str, str]]:
    """Colour and marker of one curve after the other, without an end."""
    return zip(cycle(COLOURS), cycle(MARKERS), strict=True)
