"""Pages that hold what was measured elsewhere: ``<!-- measured: speed/speed.md -->`` becomes that file, if it is."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

ABSENT = "*Not measured in this copy of the documentation.*"


def _fill(app: Sphinx, page: str, source: list[str]) -> None:
    def contents(match: re.Match[str]) -> str:
        file = Path(app.srcdir, match[1])
        app.env.note_dependency(str(file), docname=page)
        if not file.exists():
            return ABSENT
        text = f"![]({match[1]})" if file.suffix == ".png" else file.read_text(encoding="utf-8")
        return text.strip()

    source[0] = re.sub(r"<!-- measured: (\S+) -->", contents, source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("source-read", _fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
