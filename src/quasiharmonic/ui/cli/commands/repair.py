"""``qhm repair``: repair the inverted triangles of a UV map, with unchanged boundary.

Untangle the inverted triangles of the map in the input's texture coordinates (vt). The map may have seams; each of
its islands is repaired separately. Boundaries and all vertices that need not move stay fixed.

Exit status: 0 every triangle in the written file is certified positive; 1 some are not; 2 wrong input or call,
nothing written; 3 written, but the report failed.

    qhm repair model.obj -o repaired.obj
    qhm repair model.glb --whole -o repaired.glb
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from quasiharmonic.ui.cli import pipeline, written_map
from quasiharmonic.ui.cli.arguments import add_files, add_options, count, flag, number, pick

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(
        parser,
        f"{format_names('read', 'seams')} file with texture coordinates",
        f"{format_names('write_map', 'seams')} file to write",
    )
    add_options(
        parser,
        whole=flag("recompute whole islands that have inverted triangles (default: only patches around them)"),
        unmirror=flag("reflect mirrored islands in place (default: keep them, because some are intentional)"),
        max_iterations=number(count, "maximum iterations on a whole island (default: 2000)", default=2000),
    )
    add_options(parser, "linear_solver", "texture", "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, repair, write, certify, report."""
    from quasiharmonic import io

    io.find_format(options.output, "write_map", "seams")
    return pipeline.change_map(options, lambda mesh: _repair(options, mesh))


def _repair(options: argparse.Namespace, mesh: MeshData) -> pipeline.Changed:
    """Repair the map of a mesh."""
    from dataclasses import replace

    from quasiharmonic.apps.atlas.atlas_verdict import certify
    from quasiharmonic.apps.uv_repair import repair
    from quasiharmonic.io.seamed_mesh import SeamedMesh

    if mesh.vt is None or mesh.FT is None or (mesh.FT < 0).any(axis=1).all():
        raise ValueError(
            f"{options.input}: there is no map to repair: no face has texture coordinates (vt) at all three corners"
        )
    given = pick(options, "whole", "unmirror", "max_iterations", "linear_solver")
    with pipeline.show_work(options.input) as show:
        result = repair(mesh.V, mesh.F, mesh.vt, FT=mesh.FT, callback=show, **given)
    repaired = replace(mesh, vt=result.uv, FT=result.FT)

    def describe(written: MeshData) -> pipeline.Account:
        verdict = certify(SeamedMesh(written.V, written.F, written.FT, written.vt))
        sizes = {"vertices": len(mesh.V), "triangles": len(mesh.F)}
        facts = {**result.to_dict(), "injective": verdict.injective, **sizes}
        account = pipeline.Account(facts, [f"wrote {options.output}: {result.summary()}"], verdict.injective)
        written_map.add_bent(account.facts, account.closing, repaired)
        return account

    return pipeline.Changed(repaired, describe)
