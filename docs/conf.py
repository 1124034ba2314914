"""The documentation site: ``make docs`` builds it, and Read the Docs."""

from importlib.metadata import version as installed

project = "sb3-mcbs"
author = "sb3-mcbs contributors"
copyright = author
release = version = installed("sb3-mcbs")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]

html_theme = "sphinx_rtd_theme"
html_theme_options = {"navigation_depth": 2, "collapse_navigation": False}
html_show_copyright = False

# Links such as [deadlines](speed.md#deadlines) work on GitHub and here.
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings say what parameters are; the signatures would fill the page
autodoc_default_options = {"members": True, "show-inheritance": True}
