"""Sphinx configuration; ``make docs`` builds with warnings as errors."""

from __future__ import annotations

import edgeperc

project = "edgeperc"
copyright = "the edgeperc authors"
release = version = edgeperc.__version__

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx_copybutton",
    "sphinxarg.ext",
]
exclude_patterns = ["_build"]
templates_path = ["_templates"]
copybutton_prompt_text = "$ "
html_theme = "furo"
html_title = f"edgeperc {version}"

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

default_role = "py:obj"  # docstrings name things in single backticks
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc's sections give the types, with shapes and units
autosummary_generate = True
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
intersphinx_mapping: dict[str, tuple[str, None]] = {}  # the build works without a network
