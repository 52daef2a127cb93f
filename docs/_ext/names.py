"""Names in docstrings: attributes listed together are told apart, and names of the package become links wherever they
stand, not only in the module that defines them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.domains.python import PyObject
from sphinx.environment import BuildEnvironment
from sphinx.ext.napoleon.docstring import GoogleDocstring, NumpyDocstring
from sphinx.util.nodes import make_refnode

PACKAGE = "quasiharmonic."
#: Not attributes, some of which are called n or f.
LINKED = {"class", "exception", "function", "module"}


def _attributes(self: NumpyDocstring, section: str) -> list[str]:
    """``sigma1, sigma2 : (f,) float64`` is two attributes, as it would be two parameters."""
    self._consume_fields = partial(self._consume_fields, multiple=True)
    try:
        return GoogleDocstring._parse_attributes_section(self, section)
    finally:
        del self._consume_fields


def _letters(app: Sphinx, doctree: nodes.document) -> None:
    """The letters of a shape, ``(n, 2)``, are no names, although some attribute is called n."""
    for node in list(doctree.findall(pending_xref)):
        if node.get("refdomain") == "py" and len(node["reftarget"]) == 1:
            node.replace_self(node.children)


def _resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element) -> nodes.Element | None:
    """The public name, or the only one in all modules that ends so."""
    if node.get("refdomain") != "py":
        return None
    name = node["reftarget"].removesuffix("()")
    objects = {key: entry for key, entry in env.domains.python_domain.objects.items() if entry.objtype in LINKED}
    found = [PACKAGE + name] if PACKAGE + name in objects else [key for key in objects if key.endswith("." + name)]
    if len(found) != 1:
        return None
    entry = objects[found[0]]
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, found[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    NumpyDocstring._parse_attributes_section = _attributes
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.label = "Attributes"
    app.connect("doctree-read", _letters)
    app.connect("missing-reference", _resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
