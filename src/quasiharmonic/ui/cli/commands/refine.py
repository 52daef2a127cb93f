"""``qhm refine``: split edges of a problem without a map until a map may exist.

Split only the edges that qhm check lists, until it lists none. Three files are written: the mesh with an initial map
(vt), the input of qhm map; its fixed vertices, OUTPUT.handles; and the origin of its vertices and triangles,
OUTPUT.origin.json (OUTPUT without its suffix).

Exit status: 0 written, and no known obstruction to an injective map remains; 1 written, but an obstruction remains
that no refinement removes; 2 wrong input or call, nothing written; 3 written, but the report failed.

    qhm refine problem/ -o finer.obj
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from quasiharmonic.ui.cli import pipeline, report
from quasiharmonic.ui.cli.arguments import add_files, add_options

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.io import MeshData
    from quasiharmonic.problem import Problem
    from quasiharmonic.solver.refinement import RefinedProblem


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_files(parser, "OBJ file, or a folder with input.obj (or .ply) and handles.txt", "OBJ file to write")
    add_options(parser, "fixed", "json")


def run(options: argparse.Namespace) -> int:
    """Read, split, write, report."""
    from quasiharmonic import io
    from quasiharmonic.problem import Problem
    from quasiharmonic.solver.refinement import refine_problem

    output: Path = options.output
    if output.suffix.lower() != ".obj":
        raise ValueError(f"{output}: the refined mesh must be written as .obj")
    handles, origin = output.with_suffix(".handles"), output.with_suffix(".origin.json")
    mesh_path, fixed_path = io.problem_files(options.input, options.fixed)
    outputs = {"-o": output, "the list of handles": handles, "the origin": origin}
    report.check_new(outputs, options.json, inputs=(mesh_path, fixed_path))
    mesh = io.read_mesh(mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    with report.name_source(mesh_path):
        problem = Problem(*io.problem_arrays(mesh, fixed), reference="equilateral")
        result = refine_problem(problem)
    with io.no_remains(output, handles, origin):
        write(output, handles, origin, mesh, problem, result)

    def describe() -> pipeline.Account:
        split = len(result.refined.parents)
        facts = {
            "split": split,
            "rounds": result.rounds,
            "diagnosis": result.diagnosis.to_dict(),
            **report.sizes(result.problem.domain),
            **pipeline.name_files(options),
            "handles": str(handles),
            "origin": str(origin),
        }
        lines = [f"wrote {output}, {handles.name} and {origin.name}: {split} edge{'' if split == 1 else 's'} split"]
        lines.append(result.diagnosis.summary())
        if not result.diagnosis.forbids_injective:
            lines.append(f"Next: qhm map {output} --fixed {handles} -o …")
        return pipeline.Account(facts, lines, not result.diagnosis.forbids_injective)

    return pipeline.finish(options, describe, output)


def write(output: Path, handles: Path, origin: Path, mesh: MeshData, problem: Problem, result: RefinedProblem) -> None:
    """Write the three files, the mesh last: if it exists, all three are complete."""
    import json

    from quasiharmonic import io

    refined = result.refined
    new, parent = io.refined_mesh(mesh, refined, first_guess(mesh, problem))
    shares = [[share for share in row if share] for row in refined.weights.tolist()]
    made = zip(refined.parents.tolist(), shares, strict=True)
    facts = {
        "old_vertices": problem.n,
        "old_triangles": len(problem.F),
        "new_vertices": [
            {"vertex": problem.n + k, "between": between[: len(weights)], "weights": weights}
            for k, (between, weights) in enumerate(made)
        ],
        "parent_of_triangle": parent.tolist(),
    }
    io.write_whole(origin, json.dumps(facts).encode() + b"\n")
    io.write_whole(handles, "".join(f"{vertex}\n" for vertex in problem.fixed.tolist()).encode())
    io.write_obj(output, new)


def first_guess(mesh: MeshData, problem: Problem) -> NDArray[np.float64]:
    """Return the positions of all vertices in the file's map, or the centre of the target where a vertex has none."""
    import numpy as np

    from quasiharmonic import io

    uv, _ = io.vertex_places(mesh)
    middle = problem.target.min(axis=0) / 2 + problem.target.max(axis=0) / 2
    return np.where(np.isnan(uv), middle, uv)
