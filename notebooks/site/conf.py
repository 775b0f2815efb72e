"""Settings of Sphinx for the site that `build.py` assembles.

Nothing is run, and no page fetches anything from another server.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

SITE = Path(__file__).parent
sys.path.insert(0, str(SITE))

import docstrings  # noqa: E402 - beside this file

project = "pgo-splitting"
author = "The pgo-splitting authors"
project_copyright = author
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx.ext.mathjax",
    "myst_nb",
]

# Pages and notebooks. The notebooks are committed with their outputs, so they are not run here.
nb_execution_mode = "off"
nb_render_markdown_format = "myst"
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "attrs_inline"]
myst_heading_anchors = 3
myst_dmath_double_inline = True
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # which would come from a server

# The reference.
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_use_type_comments = False
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
add_module_names = False
highlight_language = "none"  # formulas and tables in docstrings; examples say what they are
python_maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

# Appearance. All scripts, fonts and styles are files beside the pages.
html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = [str(SITE / "static")]
html_css_files = ["site.css"]
html_search_scorer = str(SITE / "static" / "scorer.js")
html_copy_source = False
html_show_sourcelink = False
# Sphinx's summaries need other files, which a browser does not read when pages are opened from the
# disk; `excerpts.js` takes their place.
html_show_search_summary = False
html_context = {"default_mode": "auto"}
html_theme_options = {
    "navbar_end": ["theme-switcher"],
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "secondary_sidebar_items": ["page-toc"],
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": ["sphinx-version"],
    "pygments_light_style": "tango",
}
html_sidebars = {"benchmarks": [], "changelog": [], "proved": []}


def setup(app: object) -> None:
    """Take MathJax and plotly from packages of the extra `docs`, and convert the docstrings.

    MathJax is one file without fonts. Pages with films load plotly.
    """
    (folder,) = find_spec("sphinx-mathjax-offline").submodule_search_locations
    app.config.html_static_path.append(f"{folder}/static/mathjax/tex-svg.js")
    app.config.mathjax_path = "tex-svg.js"
    plotly = Path(find_spec("plotly").origin).parent
    app.config.html_static_path.append(f"{plotly}/package_data/plotly.min.js")
    docstrings.connect(app)
    app.connect("html-page-context", add_excerpts)


def add_excerpts(app: object, page: str, *_: object) -> None:
    """Load the texts of the pages, which `build.py` writes, where a search shows its results."""
    if page == "search":
        app.add_js_file("texts.js")
        app.add_js_file("excerpts.js")
