"""Histogram of the errors of the edges, beside the one that their information matrices expect."""

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtr, chdtri

from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.plots.interactive_plots import lay_out
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, QUIET_COLOUR, plotly
from pgo_models.problem.thresholds import FALSE_ALARM, EdgeResiduals
from solvers.reporting.convergence_plots import LOGARITHMIC

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_BARS_PER_DECADE = 8  # a bar is a factor of 10^(1/8) = 1.33 wide
# Powers of ten at which the first and the last bar end; errors beyond are in these bars.
_SMALLEST_POWER = -3
_LARGEST_POWER = 2
_LEAST_SHOWN = 0.1  # edges, on the logarithmic axis


def explore_fit(residuals: EdgeResiduals, d: int) -> "Figure":
    """Plotly histogram of the errors sqrt(cost / allowed) of the edges, and the expected one.

    The expected histogram is a dotted line, and what is allowed a vertical one. For errors as the
    information matrices say, in d dimensions, cost / allowed is chi^2_p divided by its quantile
    1 - FALSE_ALARM / m, with p = 3 or 6: exactly for chi2, and for F if its weights are equal.
    Poses that are fitted to the measurements reduce the sum of the costs to the share that
    `EdgeResiduals.overall` takes; the dotted line has every edge reduced to that share. Edges
    without an allowed cost are left out.
    """
    is_counted = residuals.allowed > 0.0
    ratio = residuals.cost[is_counted] / residuals.allowed[is_counted]
    # Decimal logarithms of the errors, and of the ends of the bars.
    error = np.log10(np.sqrt(np.maximum(ratio, 10.0 ** (2 * _SMALLEST_POWER))))
    first = int(np.floor(error.min(initial=0.0)))
    last = int(np.ceil(np.clip(error.max(initial=0.0), 0.0, _LARGEST_POWER)))
    ends = first + np.arange(_BARS_PER_DECADE * (last - first) + 1) / _BARS_PER_DECADE
    count = np.histogram(np.minimum(error, ends[-1]), ends)[0]
    p = tangent_dimension(d) + d
    quantile = chdtri(p, FALSE_ALARM / max(len(error), 1))
    unfitted = residuals.allowed.sum() / residuals.scale * p / quantile
    fitted = residuals.cost.sum() / residuals.overall if residuals.overall > 0.0 else unfitted
    expected = len(error) * np.diff(chdtr(p, quantile * unfitted / fitted * 100.0**ends))

    figure = plotly("graph_objects").Figure()
    middles = (ends[:-1] + 0.5 / _BARS_PER_DECADE).tolist()
    is_misfit = ends[:-1] >= 0.0
    for name, colour, shown in (
        ("edges", COLOURS[0], ~is_misfit),
        ("misfits", ALARM_COLOUR, is_misfit),
    ):
        if count[shown].any():
            heights = np.where(shown, count, 0).tolist()
            figure.add_bar(x=middles, y=heights, name=name, marker={"color": colour})
    curve = [float(f"{value:.4g}") if value > _LEAST_SHOWN else None for value in expected]
    figure.add_scatter(
        x=middles,
        y=curve,
        name="expected by the matrices",
        mode="lines",
        line={"color": QUIET_COLOUR, "dash": "dot"},
    )
    figure.add_vline(x=0.0, line={"color": QUIET_COLOUR, "width": 1})
    num_misfits = int(count[is_misfit].sum())
    share = f"{num_misfits} of {len(error)} edges cost" if num_misfits else "no edge costs"
    lay_out(figure, f"{share} more than allowed", legend_y=-0.25)
    figure.update_layout(bargap=0.05, barmode="stack", title_x=0.02)  # left of the tools
    powers = list(range(first, int(ends[-1]) + 1))
    figure.update_xaxes(
        tickvals=powers,
        ticktext=[f"10<sup>{power}</sup>" if power else "1" for power in powers],
        title_text="error, in parts of what is allowed",
        zeroline=False,
    )
    highest = max(1.0, count.max(initial=0), expected.max(initial=0.0))
    top = float(np.log10(2.0 * highest))
    figure.update_yaxes(**LOGARITHMIC, dtick=1, title_text="edges", range=[-0.3, top])
    return figure
