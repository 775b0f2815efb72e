"""Pictures, curves and the film of notebook 12, Bregman iteration on a photograph."""

import base64
import io
from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from plotly.graph_objects import Figure

import pgo_models as pgo
from pgo_models.plots.style import COLOURS, QUIET_COLOUR

Array = NDArray[np.float64]
Curves = Mapping[str, Sequence[float]]  # values after every iteration, by the name of the method

_JPEG_QUALITY = 70  # a frame then takes 2 to 10 kB
_FIGURE_INCHES = 7.2
_GREYS = 32  # of a panel: finer shades cost bytes, and are not to be seen


def show_pictures(panels: Sequence[tuple[str, Array]]) -> None:
    """Draw pictures with values from 0 to 1, two in a row, each below its title."""
    num_rows = (len(panels) + 1) // 2
    size = (_FIGURE_INCHES, 0.54 * _FIGURE_INCHES * num_rows)
    _, axes = plt.subplots(num_rows, 2, figsize=size, layout="constrained", squeeze=False)
    for panel, (title, picture) in zip(axes.flat, panels, strict=True):
        shades = plt.get_cmap("gray", _GREYS)
        panel.imshow(picture, cmap=shades, vmin=0, vmax=1, interpolation="nearest")
        panel.set_title(title, fontsize=10)
        panel.axis("off")


def plot_progress(
    costs: Mapping[str, Sequence[float]], qualities: Mapping[str, Sequence[float]]
) -> None:
    """Draw what each method has reached after every iteration: its cost, and its picture in dB."""
    size = (_FIGURE_INCHES, 0.42 * _FIGURE_INCHES)
    _, (left, right) = plt.subplots(1, 2, figsize=size, layout="constrained")
    for name, colour in zip(costs, COLOURS, strict=False):
        left.semilogy(costs[name], label=name, color=colour)
        right.plot(qualities[name], label=name, color=colour)
    left.set(xlabel="iteration", ylabel="cost over the lowest, minus 1")
    right.set(xlabel="iteration", ylabel="dB to the true picture")
    right.legend(fontsize=8)


def film_of_iterates(iterates: Sequence[Array], noisy: Array, truth: Array, noise: float) -> Figure:
    """Film of the iterates of Bregman iteration above their distances to f and to the truth."""
    steps = list(range(1, len(iterates) + 1))
    to_data = [_rms(u - noisy) for u in iterates]
    to_truth = [_rms(u - truth) for u in iterates]
    still = [
        _curve(steps, to_data, "u to the noisy f", COLOURS[0]),
        _curve(steps, to_truth, "u to the truth", COLOURS[1]),
        {
            **_curve([0.0, steps[-1] + 1.0], [noise, noise], "noise", QUIET_COLOUR),
            "mode": "lines",
            "line": {"color": QUIET_COLOUR, "dash": "dot"},
        },
    ]
    frames = [
        [_picture(u), _places([k, k], [to_data[k - 1], to_truth[k - 1]])]
        for k, u in zip(steps, iterates, strict=True)
    ]
    frames.append([_picture(noisy), _places([], [])])
    labels = [
        f"k = {k}: {_decibel(error):.1f} dB" for k, error in zip(steps, to_truth, strict=True)
    ]
    labels.append(f"the limit, f: {_decibel(_rms(noisy - truth)):.1f} dB")
    best = int(np.argmin(to_truth)) + 1
    description = (
        f"The picture u after each of {steps[-1]} Bregman iterations: large flat areas first, then "
        f"the details of a face, and noise in the end. The distance to the noisy f falls from "
        f"{to_data[0]:.2f} to {to_data[-1]:.2f} a pixel; the distance to the true picture is least "
        f"at k = {best}, with {to_truth[best - 1]:.3f}, and rises after it."
    )
    return pgo.animate(
        frames,
        labels,
        still=still,
        layout=_layout(truth.shape, steps[-1], max(to_data + to_truth)),
        title="Bregman iteration of total variation",
        description=description,
    )


def _layout(shape: tuple[int, ...], num_steps: int, largest: float) -> dict[str, object]:
    """The picture above, without axes and with square pixels; the curves below it."""
    height, width = shape
    hidden = {"visible": False, "fixedrange": True}
    return {
        "height": 760,
        "margin": {"l": 55, "r": 10, "t": 40, "b": 20},
        "xaxis": {**hidden, "range": [-0.5, width - 0.5], "constrain": "domain"},
        "yaxis": {
            **hidden,
            "range": [height - 0.5, -0.5],
            "scaleanchor": "x",
            "constrain": "domain",
            "domain": [0.34, 1.0],
        },
        "xaxis2": {
            "range": [0.5, num_steps + 0.5],
            "anchor": "y2",
            "dtick": 1,
            "title": {"text": "iteration k", "standoff": 4},
            "zeroline": False,
            "gridcolor": "#eeeeee",
        },
        "yaxis2": {
            "range": [0.0, 1.1 * largest],
            "anchor": "x2",
            "domain": [0.0, 0.24],
            "title": {"text": "rms a pixel"},
            "gridcolor": "#eeeeee",
        },
        "legend": {"orientation": "h", "x": 0.0, "y": 0.25, "yanchor": "bottom"},
    }


def _picture(values: Array) -> dict[str, object]:
    """Image trace of a picture with values from 0 to 1, as a JPEG in its text."""
    greys = np.clip(255.0 * values + 0.5, 0.0, 255.0).astype(np.uint8)
    coded = io.BytesIO()
    Image.fromarray(greys).save(coded, format="jpeg", quality=_JPEG_QUALITY, optimize=True)
    text = base64.b64encode(coded.getvalue()).decode("ascii")
    return {"type": "image", "source": f"data:image/jpeg;base64,{text}", "hoverinfo": "skip"}


def _curve(x: Sequence[float], y: Sequence[float], name: str, colour: str) -> dict[str, object]:
    """Trace of a curve in the lower part."""
    return {
        "x": list(x),
        "y": [round(value, 4) for value in y],
        "xaxis": "x2",
        "yaxis": "y2",
        "mode": "lines+markers",
        "marker": {"size": 5},
        "line": {"color": colour},
        "name": name,
    }


def _places(x: Sequence[float], y: Sequence[float]) -> dict[str, object]:
    """Trace of the rings around the points of the current iterate."""
    return {
        "x": list(x),
        "y": [round(value, 4) for value in y],
        "xaxis": "x2",
        "yaxis": "y2",
        "mode": "markers",
        "marker": {"size": 14, "symbol": "circle-open", "color": "#000000", "line": {"width": 2}},
        "showlegend": False,
    }


def _rms(difference: Array) -> float:
    """Root mean square over the pixels."""
    return float(np.sqrt(np.mean(difference**2)))


def _decibel(error: float) -> float:
    """Decibels of a root mean square error, of pictures with values from 0 to 1."""
    return float(-20.0 * np.log10(error))
