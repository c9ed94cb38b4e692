"""The documentation site: `sphinx-build -W --keep-going docs docs/_build/html`, from nothing but this repository.

Sphinx with MyST: the pages are the Markdown files that GitHub shows, too, the API comes from the docstrings, and the
gallery's notebooks are executed by the build. Nothing is asked of a network, neither by the build nor by a page.
"""

import os
import sys
from importlib import metadata
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_extensions"), str(HERE.parent)]
# The gallery is executed with this tree, on the processor, where XLA compiles quickly: every program runs a few times.
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

project = "rfem_jax"
author = "The rfem_jax developers"
copyright = "the rfem_jax developers, Apache-2.0"
version = release = metadata.version("rfem_jax")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # MathJax and its fonts as files of the site
    "docstrings",
    "pages_from_code",
    "repository_links",
]
exclude_patterns = ["_build", "README.md"]
default_role = "literal"

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
myst_dmath_double_inline = True

nb_execution_mode = "cache"
nb_execution_timeout = 1800
nb_execution_raise_on_error = True
nb_execution_in_temp = False  # paths are those from docs/gallery
nb_merge_streams = True
nb_output_stderr = "remove"  # remarks on slow compilation

# MathJax 3, which numbers nothing itself: the numbers are the tags of the theory.
mathjax3_config = {"tex": {"tags": "none"}, "options": {"enableMenu": False}}

autodoc_typehints = "none"  # shapes and units are in the docstrings
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True

html_theme = "furo"
html_title = f"rfem_jax {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
suppress_warnings = ["mystnb.unknown_mime_type"]
