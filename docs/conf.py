"""How the documentation is built: ``python -m sphinx -W docs docs/_build/html``, without network."""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent / "examples")]
# Scripts of the gallery are measured on one core, so that times compare.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from pictures import picture_scraper  # noqa: E402
from standalone import write_gallery  # noqa: E402

from quasiharmonic import __version__  # noqa: E402

project = "quasiharmonic"
author = "The quasiharmonic developers"
copyright = author
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.doctest",
    "sphinx.ext.napoleon",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "bars",
    "commands",
    "mathml",
    "names",
    "page_examples",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = [
    "_build",
    "_examples",
    "_templates",
    "sg_execution_times.rst",
    "choose/*",
    "comparisons/*",
    "mesh_motion/*",
    "speed/*",
]
templates_path = ["_templates"]
suppress_warnings = [
    "config.cache",  # the gallery's scraper is a function
    "ref.python",  # a class found under its public name and in its own module is the same class
]

myst_enable_extensions = ["dollarmath", "colon_fence", "attrs_block"]
myst_heading_anchors = 3
autosummary_generate = True
autodoc_typehints = "none"  # the docstrings say shapes and types
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_ivar = True
default_role = "py:obj"
nitpicky = False

write_gallery(HERE.parent / "examples", HERE / "_examples")
sphinx_gallery_conf = {
    "examples_dirs": ["_examples"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "image_scrapers": (picture_scraper,),
    "reset_modules": (),
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "within_subsection_order": "order.by_kind",
    "notebook_images": False,
}

html_theme = "furo"
html_title = "quasiharmonic"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_show_sphinx = False
