"""Draw the pictures of the gallery by running the lines that stand below them on its page.

    python notebooks/site/gallery.py            # all pictures
    python notebooks/site/gallery.py graph film # these alone; all lines are run

A block of Python that follows a picture makes it, as the variable `figure` or as a page of HTML.
The pictures are written to notebooks/pictures/gallery as PNG with a palette. Figures of plotly and
pages are photographed in a headless Chromium; where there is none, they are left as they are, and
the command says which.
"""

import argparse
import base64
import doctest
import io
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

SITE = Path(__file__).parent
ROOT = SITE.parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from browser import Browser, find_browser  # noqa: E402 - on the path that is set above

PAGE = SITE / "guide" / "gallery.md"
PICTURES = ROOT / "notebooks" / "pictures" / "gallery"
PIECE = re.compile(r"^!\[[^\]]*\]\((\S+)\)$|^```python\n(.*?)^```$", re.M | re.S)
DOTS_PER_INCH = 130
WIDEST = 680  # pixels
COLOURS = 48
WINDOW = (620, 500)


def blocks_with_pictures(text: str) -> list[tuple[str, str]]:
    """Return the blocks of Python of a page, each with the name of the picture before it or ""."""
    blocks = []
    picture = ""
    for match in PIECE.finditer(text):
        if match[1]:
            picture = Path(match[1]).stem
        else:
            blocks.append((match[2], picture))
            picture = ""
    return blocks


def drawn(blocks: list[tuple[str, str]]) -> Iterator[tuple[str, object]]:
    """Run the blocks, and yield the name of each picture with its figure or its page."""
    names: dict[str, object] = {}
    for block, picture in blocks:
        names.pop("figure", None)
        pages = set(Path().glob("*.html"))
        source = "".join(example.source for example in doctest.DocTestParser().get_examples(block))
        exec(compile(source, f"{PAGE.name}: {picture}", "exec"), names)
        new_pages = sorted(set(Path().glob("*.html")) - pages)
        if picture:
            yield picture, names["figure"] if "figure" in names else new_pages[0]


def photographed(page: Path, browser: Browser) -> bytes:
    """Return a screenshot of the figure of a page, or of the window that shows a report."""
    browser.open(page)
    browser.wait_for("document.querySelector('.main-svg, canvas') !== null")
    browser.value("new Promise(done => setTimeout(() => done(1), 1500))")  # for WebGL
    width, height = browser.value(
        "(f => f && f.parentElement.parentElement === document.body"
        " ? [f.clientWidth, f.clientHeight] : [innerWidth, innerHeight])"
        "(document.querySelector('.plotly-graph-div'))"
    )
    clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
    picture = {"clip": clip, "captureBeyondViewport": True}
    return base64.b64decode(browser.call("Page.captureScreenshot", picture)["data"])


def small(png: bytes) -> bytes:
    """Return a picture that is not wider than the page, with few colours."""
    from PIL import Image

    image = Image.open(io.BytesIO(png)).convert("RGB")
    if image.width > WIDEST:
        size = (WIDEST, round(image.height * WIDEST / image.width))
        image = image.resize(size, Image.Resampling.LANCZOS)
    out = io.BytesIO()
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(out, format="PNG", optimize=True)
    return out.getvalue()


def png_of(figure: object, picture: str, browser: Browser | None) -> bytes | None:
    """Return a figure as PNG, or None if it needs a browser and there is none."""
    if hasattr(figure, "savefig"):
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=DOTS_PER_INCH)
        return png.getvalue()
    if browser is None:
        return None
    if isinstance(figure, Path):
        return photographed(figure, browser)
    page = Path(f"{picture}.html")
    figure.write_html(page, auto_play=False, config={"displayModeBar": False})
    png = photographed(page, browser)
    page.unlink()
    return png


def opened_browser(profile: Path) -> Browser | None:
    """Return a headless Chromium, or None."""
    if find_browser() is None:
        return None
    browser = Browser(profile)
    width, height = WINDOW
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    browser.call("Emulation.setDeviceMetricsOverride", metrics)
    browser.call("Emulation.setScrollbarsHidden", {"hidden": True})
    return browser


def main() -> int:
    """Draw the pictures, and return 1 if some could not be drawn."""
    parser = argparse.ArgumentParser(description="Draw the pictures of the gallery.")
    parser.add_argument("only", nargs="*", help="names of pictures; all unless given")
    only = set(parser.parse_args().only)
    PICTURES.mkdir(parents=True, exist_ok=True)
    missing = []
    blocks = blocks_with_pictures(PAGE.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        browser = opened_browser(Path(folder) / "profile")
        for picture, figure in drawn(blocks):
            if only and picture not in only:
                continue
            png = png_of(figure, picture, browser)
            if png is None:
                missing.append(picture)
                continue
            path = PICTURES / f"{picture}.png"
            path.write_bytes(small(png))
            print(f"{path.stat().st_size / 1e3:6.1f} kB  {path.relative_to(ROOT)}", flush=True)
        if browser is not None:
            browser.__exit__()
        os.chdir(ROOT)
    if missing:
        print(f"no Chromium was found, which these pictures need: {', '.join(missing)}")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
