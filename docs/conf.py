"""The documentation site: ``python -m sphinx -W --keep-going -b html docs build/site``.

The pages are plain Markdown that reads as well on a code host or in an editor. What the site adds
(navigation, the reference, pages for source files that are linked) is made by the extension in
``_extensions/laboratory`` at build time.
"""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_extensions"), str(HERE.parent)]

from trms_cli import __version__  # noqa: E402

project = "trms"
author = "the trms authors"
version = release = __version__
copyright = "the trms authors, MIT licence"
language = "en"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "laboratory",
]
exclude_patterns = [
    "_build",
    "_extensions",
    "example_plugin",
    "figures",
    "templates",
    "**/.ipynb_checkpoints",
]

# Markdown as code hosts render it; headings are link targets by the same rule as there.
myst_enable_extensions = ["strikethrough", "dollarmath"]
myst_dmath_allow_digits = False  # a dollar beside a digit is money
myst_heading_anchors = 4
myst_links_external_new_tab = False

# Notebooks are executed by a test, never by the build; nothing is fetched for their widgets.
nb_execution_mode = "off"
nb_ipywidgets_js = {}

# Every cross-reference has to lead somewhere. Types in signatures are left out: they name
# libraries whose inventories would have to be fetched.
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]
suppress_warnings = [
    "ref.python",  # two rooms may call a class alike: Signal
    "myst-nb.lexer",  # a notebook without outputs does not name its language's lexer
]

# What is typed has a copy button, what is printed has none; of a session the commands are copied.
copybutton_selector = "div:not(.highlight-text):not(.output) > div.highlight > pre"
copybutton_prompt_text = "$ "

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
python_use_unqualified_type_names = True
add_module_names = False

html_math_renderer = "mathml"
html_theme = "furo"
html_title = "trms"
html_favicon = "_static/rig.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {
    "light_logo": "rig.svg",
    "dark_logo": "rig.svg",
    "top_of_page_buttons": [],
    "navigation_with_keys": True,
    # dark enough on white, light enough on black
    "light_css_variables": {"color-brand-primary": "#00558c", "color-brand-content": "#00558c"},
    "dark_css_variables": {"color-brand-primary": "#7cc4f0", "color-brand-content": "#7cc4f0"},
}
# every colour of both is dark or light enough for small letters (they come with the theme)
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"

# `make docs-links` only: needs a network.
linkcheck_timeout = 20
linkcheck_anchors = False
