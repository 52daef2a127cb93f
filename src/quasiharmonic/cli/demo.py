"""``qhm demo``: a curved surface of the package's own onto a letter."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "demo",
        help="make a surface and a letter, map the one onto the other, draw it",
        description="Make a curved surface, map it onto the outline of a letter, and write demo.obj, demo.png and "
        "demo.json.",
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("qhm-demo"), metavar="DIR", help="(default: qhm-demo)")
    parser.set_defaults(run=run)
