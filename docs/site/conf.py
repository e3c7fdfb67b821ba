"""The site of the documentation: `nox -s docs` builds it from the pages as they are in git.

The root of the repository is Sphinx's source folder, so that links between the README, the pages
in `docs` and the files that they name are the same on GitHub and here. `toc.yml` is the navigation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sphinx import addnodes

import wasp_cli

project = "wasp"
release = wasp_cli.__version__
version = release
html_title = f"wasp {release}"
copyright = "wasp contributors, Apache-2.0"

extensions = [
    "myst_nb",
    "sphinx_external_toc",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]

exclude_patterns = [
    ".nox",
    ".venv",
    "build",
    "leaderboard",
    "results",
    "specs",
    "tests",
    "wasp_cli",
]
# Which files are pages: those that the navigation names.
external_toc_path = "docs/site/toc.yml"
external_toc_exclude_missing = True

html_theme = "furo"
html_extra_path = ["start"]
html_show_sourcelink = False
html_copy_source = False

myst_heading_anchors = 4
nb_execution_mode = "off"

# Docstrings: `name` is code, "Args:" and "Raises:" are sections.
default_role = "code"
napoleon_numpy_docstring = False
napoleon_use_rtype = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "undoc-members": True}


def folders_as_text(app: Any, page: Any) -> None:
    """Replace links to folders of the repository by their text: GitHub lists what is in a folder,
    and the site has no page of it. Every other link without a target ends the build.
    """
    here = Path(app.srcdir, app.env.docname).parent
    for link in list(page.findall(addnodes.pending_xref)):
        if (here / link["reftarget"]).is_dir():
            link.replace_self(link.children)


def asterisks_as_text(app: Any, what: str, name: str, obj: Any, options: Any, lines: Any) -> None:
    """Mask the asterisks of docstrings, as in `[B, *shape]`: none of them is emphasis."""
    lines[:] = [line.replace("*", r"\*") for line in lines]


def setup(app: Any) -> None:
    app.connect("doctree-read", folders_as_text)
    app.connect("autodoc-process-docstring", asterisks_as_text, priority=400)
