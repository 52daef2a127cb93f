"""``qhm diagnose``: report why a mesh and a target admit no map."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.ui.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.ui.cli import arguments

    parser = commands.add_parser(
        "diagnose",
        help="find obstructions to a map, and remedies",
        description="Look for obstructions: conditions that every injective (or bijective) map of this mesh onto this "
        "target would have to meet and cannot. Finding none proves nothing.",
        epilog="Exit status: 0 nothing forbids an injective map; 1 something does; 2 wrong input or call.",
    )
    parser.add_argument(
        "input",
        type=Path,
        metavar="INPUT",
        help="OBJ, PLY, GLB or glTF file, or a folder with input.obj and handles.txt",
    )
    parser.add_argument(
        "--fixed",
        type=Path,
        metavar="FILE",
        help="file of fixed vertices, 0-based, one per line (default: the boundary)",
    )
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, diagnose, report."""
    from quasiharmonic import io
    from quasiharmonic.problem import Problem
    from quasiharmonic.problem.diagnosis import diagnose
    from quasiharmonic.ui.cli import report

    mesh_path, fixed_path = io.problem_files(options.input, options.fixed)
    report.check_json(options.json, inputs=(mesh_path, fixed_path))
    mesh = io.read_mesh(mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    with report.about(mesh_path):
        problem = Problem(*io.problem_arrays(mesh, fixed), reference="equilateral")
    diagnosis = diagnose(problem)
    facts = {**diagnosis.to_dict(), **report.sizes(problem.domain), "input": str(options.input)}
    report.emit_verdict(facts, options.json, f"{options.input}: {diagnosis.summary()}")
    return 1 if diagnosis.forbids_injective else 0
