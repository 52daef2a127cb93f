"""A bar is a bar: ``|μ|`` in a docstring is an absolute value and not reStructuredText's substitution."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.parsers.rst.states import Inliner
from sphinx.application import Sphinx


def _bar(
    _self: Inliner, match: re.Match[str], _line: int
) -> tuple[str, list[nodes.Node], str, list[nodes.system_message]]:
    end = match.end("start")
    return match.string[:end], [], match.string[end:], []


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    Inliner.dispatch["|"] = _bar
    return {"parallel_read_safe": True, "parallel_write_safe": True}
