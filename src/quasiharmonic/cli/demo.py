"""``qhm demo``: a curved surface of the package's own onto a letter."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.cli.arguments import Commands

LETTER = "R"


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "demo",
        help="make a surface and a letter, map the one onto the other, draw it",
        description="Make the head of a cat, map it onto the letter R, and write demo.obj, demo.png and demo.json.",
        epilog="Exit status: 0 the written map is certified injective; 1 it is not; 2 nothing was written; 3 the map "
        "was written, but not what should be told about it.",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("qhm-demo"), metavar="DIR", help="folder to write to (qhm-demo)"
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Make, map, write, judge, draw, report."""
    from quasiharmonic import io, surfaces, targets
    from quasiharmonic.cli import map, report
    from quasiharmonic.mesh.topology import boundary_loops
    from quasiharmonic.problem import Problem

    folder: Path = options.output
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"cannot make the folder {folder}: {error.strerror}") from error
    V, F = surfaces.cat()
    (loop,) = boundary_loops(F, len(V))
    problem = Problem(V, F, loop, targets.arc_length(V[loop], targets.letter(LETTER)[0]))
    result = map.search(problem, "speed", None, 2000, "auto")
    certificate = map.write(folder / "demo.obj", io.MeshData(V, F), result)
    with report.after_writing(folder / "demo.obj"):
        map.draw(folder / "demo.png", problem, result, certificate)
        facts = {**result.to_dict(), **report.verdict(certificate), **report.sizes(problem.domain)}
        report.emit(facts, str(folder / "demo.json"), report.of_map(result, certificate, folder / "demo.obj"))
        print(f"also wrote {folder / 'demo.png'} and {folder / 'demo.json'}")
    return 0 if certificate.injective else 1
