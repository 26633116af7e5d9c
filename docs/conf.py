"""Configuration of the documentation site; `scripts/build_docs.sh` builds it.

Why Sphinx with furo and not mkdocs-material: docstrings are numpy's, and numpydoc reads them as they are;
the pages are the same Markdown that a repository shows (MyST); nothing, fonts included, is loaded from
elsewhere when a page is viewed; and mkdocs needs a plug-in for each of these. The source folder is the
repository itself, so that links between the README, docs/ and firmware_proto/ hold in both places.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "src"), str(HERE / "_extensions")]

project = "adis-gonio"
version = release = tomllib.loads((HERE.parent / "pyproject.toml").read_text("utf-8"))["project"]["version"]
copyright = ""

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "sphinx.ext.viewcode",
    "mathml",
]
root_doc = "docs/index"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**", "firmware_proto/*.md"]
include_patterns += ["benchmarks/blind_residual/*.md", "examples/*/README.md"]
exclude_patterns = [".*", "build", "src", "tests", "scripts", "docs/_*"]
templates_path = [str(HERE / "_templates")]
suppress_warnings = ["config.cache"]

myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 3
myst_links_external_new_tab = False

default_role = "code"
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
maximum_signature_line_length = 88
numpydoc_show_class_members = False

html_theme = "furo"
html_title = f"adis-gonio {release}"
html_math_renderer = "mathml"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_use_index = False
html_additional_pages = {"index": "redirect.html"}
