"""The contents of the page: its static files, read only from the package, and the options of `unwrap` that it offers.

The options have the defaults, choices and explanations of `UnwrapOptions`.
"""

from __future__ import annotations

import re
from dataclasses import fields
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from quasiharmonic.util.options import UnwrapOptions

_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
_IMPORT = re.compile(r'^import (\{[^}]*\}) from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (\w+))", re.MULTILINE)

# Explanations of the options that the command line explains itself, because files have a part in them.
_TEXTS = {
    "hard_edges": "seams at all edges with a larger angle between the normals, in degrees, as normal maps need them",
    "labels": "parts of the file, between which seams cost almost nothing",
}
_CHOICES = {"labels": ("groups", "materials")}
#: Names of the options, in the order of the page.
OPTION_NAMES = (
    *("max_stretch", "max_charts", "symmetry", "hard_edges", "labels", "straighten", "up"),
    *("divide_for_packing", "texels_per_unit"),
)


class Asset(NamedTuple):
    """File of the page: its bytes and its content type."""

    content: bytes
    kind: str


@cache
def assets() -> dict[str, Asset]:
    """Return all files of the page by name."""
    found = {}
    for entry in files(__package__).joinpath("static").iterdir():
        kind = _KINDS.get(entry.name.rpartition(".")[2])
        if kind is not None and entry.is_file():
            found[entry.name] = Asset(entry.read_bytes(), kind)
    return found


def bundle(name: str) -> str:
    """Return a module of the page, such as ``view``, with all modules that it imports, as one JavaScript module.

    KeyError if there is no such module.
    """
    wrapped: dict[str, str] = {}

    def wrap(module: str) -> list[str]:
        text = assets()[f"{module}.js"].content.decode()
        for _, other in _IMPORT.findall(text):
            if other not in wrapped:
                wrap(other)
        exported = _EXPORT.findall(text)
        inside = _EXPORT.sub("", _IMPORT.sub(r"const \1 = qhm_\2;", text))
        wrapped[module] = f"const qhm_{module} = (() => {{\n{inside}\nreturn {{ {', '.join(exported)} }};\n}})();\n"
        return exported

    exported = wrap(name)
    return "\n".join([*wrapped.values(), f"export const {{ {', '.join(exported)} }} = qhm_{name};\n"])


def offered_options() -> list[dict[str, Any]]:
    """Return name, explanation, default and choices of each option; a switch has the default False."""
    known = {one.name: one for one in fields(UnwrapOptions)}
    return [
        {
            "name": name,
            "help": (known[name].metadata["help"] or _TEXTS[name]).replace("%%", "%"),
            "default": known[name].default,
            "choices": known[name].metadata["choices"] or _CHOICES.get(name, ()),
        }
        for name in OPTION_NAMES
    ]
