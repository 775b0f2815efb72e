"""HTML pages with one plotly figure, which open offline; a film there also goes by the keyboard."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING

from pgo_models.files import replace_when_done

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

FILM = "application/vnd.plotly.v1+json"  # a figure of plotly, in the output of a notebook's cell
# A page sends nothing away: plotly's button to share a chart would upload it.
PAGE_CONFIG: dict[str, object] = {
    "displaylogo": False,
    "showSendToCloud": False,
    "responsive": True,
    "modeBarButtonsToRemove": ["sendChartToCloud"],
}
# Plotly's slider answers the pointer alone. With the figure in focus the arrows step, Home and End
# go to the first and the last frame, and the space bar plays and stops. What the figure shows is
# read out from its description and from a line that follows the slider.
# Plotly draws before a page is laid out, and then hears of changes of the window alone: here every
# figure follows the width of what it is in. An animation that another one breaks off is a promise
# that is rejected, which is no error.
FILM_KEYS = """
document.querySelectorAll('.plotly-graph-div').forEach(function (film) {
  if (!film.dataset.followsWidth) {
    film.dataset.followsWidth = 'yes';
    const fit = function () { Plotly.Plots.resize(film).catch(function () {}); };
    new ResizeObserver(fit).observe(film.parentElement);
  }
  const layout = film.layout || {};
  const steps = layout.sliders && layout.sliders.length ? layout.sliders[0].steps : [];
  const description = layout.meta && layout.meta.description;
  if (description) {
    film.setAttribute('role', 'img');
    film.setAttribute('aria-label', description);
  }
  if (!steps.length || film.dataset.hasKeys) { return; }
  film.dataset.hasKeys = 'yes';
  film.tabIndex = 0;
  const status = document.createElement('p');
  status.className = 'film-status';
  status.setAttribute('aria-live', 'polite');
  status.style.cssText = 'position:absolute;clip-path:inset(50%);height:1px;width:1px;';
  film.insertAdjacentElement('afterend', status);
  let isPlaying = false;
  const at = function () { return film._fullLayout.sliders[0].active || 0; };
  const say = function (frame) { status.textContent = frame; };
  const show = function (k) {
    const frame = steps[Math.max(0, Math.min(steps.length - 1, k))].args[0][0];
    const shown = Plotly.animate(film, [frame], steps[0].args[1]);
    shown.then(function () { say(frame); }, function () {});
  };
  film.on('plotly_sliderchange', function (event) { say(event.step.args[0][0]); });
  film.addEventListener('keydown', function (event) {
    const last = steps.length - 1;
    const k = {ArrowRight: at() + 1, ArrowLeft: at() - 1, Home: 0, End: last}[event.key];
    if (k !== undefined) { isPlaying = false; show(k); event.preventDefault(); }
    if (event.key === ' ') {
      const buttons = layout.updatemenus[0].buttons;
      isPlaying = !isPlaying;
      Plotly.animate(film, ...buttons[isPlaying ? 0 : 1].args).catch(function () {});
      event.preventDefault();
    }
  });
});
"""


def save_page(figure: Figure, path: Path | str) -> None:
    """Write a plotly figure as an HTML page that opens offline.

    The script of plotly adds about 5 MB to the page. A `description` in the figure's `meta` is
    written below it. Errors are those of `replace_when_done`.
    """
    body = figure_html(figure, script=True, height="92vh")
    title = figure.layout.title.text or Path(path).stem
    page = (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8" />'
        f"<title>{html.escape(title)}</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1" />'
        f"</head><body>{body}</body></html>"
    )
    with replace_when_done(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def figure_html(figure: Figure, script: bool | str, height: str) -> str:
    """Return the part of a page that shows a plotly figure, and below it what it shows in words.

    Plotly is in the part itself where `script` is true, and else is loaded from this address.
    """
    has_frames = len(figure.frames) > 0  # whose controls a bar of tools would cover
    part: str = figure.to_html(
        full_html=False,
        include_plotlyjs=script,
        config={**PAGE_CONFIG, "displayModeBar": False} if has_frames else PAGE_CONFIG,
        auto_play=False,
        default_height=height,
        post_script=FILM_KEYS,
    )
    description = (figure.layout.meta or {}).get("description", "")
    return f"{part}<p>{html.escape(description)}</p>" if description else part
