"""Sphinx configuration."""

from importlib.metadata import version as installed

project = "mauvecl"
author = "the mauvecl developers"
release = version = installed("mauvecl")
extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
]
myst_enable_extensions = ["dollarmath", "amsmath"]
html_theme = "pydata_sphinx_theme"
html_title = "mauvecl"
exclude_patterns = ["_build"]
numpydoc_show_class_members = False
autodoc_typehints = "none"
