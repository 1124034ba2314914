"""The documentation site: ``make docs`` builds it, and Read the Docs."""

import re

from sphinx.application import Sphinx
from sphinx.util.inspect import signature, stringify_signature

import sb3_mcbs

project = "sb3-mcbs"
author = "sb3-mcbs contributors"
copyright = author
release = version = sb3_mcbs.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]

html_theme = "sphinx_rtd_theme"
html_theme_options = {"navigation_depth": 2, "collapse_navigation": False}
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]

# Links such as [deadlines](speed.md#deadlines) work on GitHub and here.
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings say what parameters are; the signatures would fill the page
autodoc_default_options = {"members": True, "show-inheritance": True}


#: Files beside this folder that are pages here.
PAGES = {"SECURITY.md": "security.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def follow_links(_app: Sphinx, name: str, source: list[str]) -> None:
    """Let links to files beside this folder, which are right on GitHub, lead to their pages here.

    Folders have none: of those links only the text remains.
    """
    for file, page in PAGES.items():
        source[0] = source[0].replace(f"](../{file}", f"]({page}")
    if "/" not in name:
        source[0] = re.sub(r"\[([^\]]*)\]\(\.\./[\w/]+\)", r"\1", source[0])


def own_signature(
    _app: Sphinx,
    what: str,
    _name: str,
    documented: object,
    _options: object,
    found: str | None,
    returned: str | None,
) -> tuple[str | None, str | None]:
    """Show the parameters of a class's constructor also where ``__new__`` takes anything."""
    if what == "class" and found == "(*args, **kwargs)":
        found = stringify_signature(signature(documented.__init__, bound_method=True), show_annotation=False)
        returned = None
    return found, returned


def setup(app: Sphinx) -> None:
    app.connect("source-read", follow_links)
    app.connect("autodoc-process-signature", own_signature)
