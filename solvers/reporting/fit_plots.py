"""A picture of how well edges fit: the histogram of their errors beside the one that their information expects."""

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtr, chdtri

from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.plots.interactive_plots import lay_out
from pgo_models.plots.style import ALARM_COLOUR, COLOURS, plotly
from pgo_models.problem.thresholds import FALSE_ALARM, EdgeResiduals
from solvers.reporting.convergence_plots import LOGARITHMIC

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

_BARS = 8  # a decade
_LEAST, _MOST = -3, 2  # powers of ten where the first and the last bar end, which hold all beyond


def explore_fit(residuals: EdgeResiduals, d: int) -> "Figure":
    """Plotly histogram of sqrt(cost / allowed) of the edges, and the line of as many errors as their matrices say.

    Of such an error in d dimensions, cost / allowed is chi^2_p over its quantile 1 - FALSE_ALARM / m, with p = 3 or 6:
    for chi2 exactly, for F where its weights are equal. Edges that may cost nothing are left out.
    """
    counted = residuals.allowed > 0.0
    size = np.log10(np.sqrt(np.maximum(residuals.cost[counted] / residuals.allowed[counted], 10.0 ** (2 * _LEAST))))
    first = int(np.floor(size.min(initial=0.0)))
    edges = first + np.arange(_BARS * (int(np.ceil(np.clip(size.max(initial=0.0), 0.0, _MOST))) - first) + 1) / _BARS
    count, p = np.histogram(np.minimum(size, edges[-1]), edges)[0], tangent_dimension(d) + d
    expected = len(size) * np.diff(chdtr(p, chdtri(p, FALSE_ALARM / max(len(counted), 1)) * 100.0**edges))
    middles = (edges[:-1] + 0.5 / _BARS).tolist()
    figure = plotly("graph_objects").Figure()
    for name, colour, shown in (("edges", COLOURS[0], edges[:-1] < 0.0), ("misfits", ALARM_COLOUR, edges[:-1] >= 0.0)):
        if count[shown].any():
            figure.add_bar(x=middles, y=np.where(shown, count, 0).tolist(), name=name, marker={"color": colour})
    curve = [float(f"{value:.4g}") if value > 0.1 else None for value in expected]
    figure.add_scatter(x=middles, y=curve, name="as the matrices say", mode="lines", line={"color": COLOURS[5]})
    lay_out(figure, "", legend_y=-0.25)
    figure.update_layout(bargap=0.05, barmode="stack")
    tens = list(range(first, int(edges[-1]) + 1))
    ticks = {"tickvals": tens, "ticktext": [f"10<sup>{power}</sup>" if power else "1" for power in tens]}
    figure.update_xaxes(**ticks, title_text="error, in parts of what is allowed", zeroline=False)
    top = float(np.log10(2.0 * max(1.0, count.max(initial=0), expected.max(initial=0.0))))
    figure.update_yaxes(**LOGARITHMIC, dtick=1, title_text="edges", range=[-0.3, top])
    return figure
