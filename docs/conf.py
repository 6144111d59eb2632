"""Configuration of the documentation site (Sphinx). Build it with `make docs`."""

from __future__ import annotations

from importlib.metadata import version as installed_version

project = "opc4-sil"
copyright = "the opc4-sil authors"
release = version = installed_version("opc4-sil")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["*.py"]
nitpicky = False
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_ivar = True

html_theme = "furo"
html_title = "opc4-sil"
html_copy_source = False
