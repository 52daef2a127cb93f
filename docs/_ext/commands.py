"""The page of the command line, from what ``qhm … --help`` prints."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from quasiharmonic.ui import cli


def _write(app: Sphinx) -> None:
    os.environ["COLUMNS"] = "100"
    parser = cli.parser_of(cli.COMMANDS)
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    lines = ["# The command `qhm`", "", str(parser.description), ""]
    lines += ["Exit status: 0 what was asked for holds; 1 a map was written or judged that is not injective;", ""]
    lines[-2] += (
        " 2 the input or the call is wrong, and nothing was written; 3 a map was written, but not the report about it."
    )
    for name, command in commands.choices.items():
        lines += [f"## qhm {name}", "", "```text", command.format_help().rstrip(), "```", ""]
    Path(app.srcdir, "command.md").write_text("\n".join(lines), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
