"""Static files of the page, read only from the package."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from typing import NamedTuple

_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
_IMPORT = re.compile(r'^import (\{[^}]*\}) from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (\w+))", re.MULTILINE)


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
