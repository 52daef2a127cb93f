"""``qhm bake``: bake the look of a model into textures for new texture coordinates.

Bake the materials, textures and vertex colours of OLD into textures for the texture coordinates of NEW, and write NEW
with them. NEW has the triangles of OLD, or is another mesh at the same place, such as a reduced one.

Exit status: 0 the whole look is baked; 1 parts are missing, which the report names; 2 wrong input or call, nothing
written; 3 written, but the report failed.

    qhm bake scan.glb reduced.glb -o textured.glb
    qhm bake old.glb unwrapped.glb --size 4096 --samples 2 -o new.glb
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from quasiharmonic.ui.cli import pipeline
from quasiharmonic.ui.cli.arguments import (
    add_files,
    add_options,
    declare_options,
    number,
    pick,
    texture_size,
)
from quasiharmonic.util.options import BakeOptions

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(
        parser,
        f"{format_names('read')} file: the old model, with its materials and colours",
        f"{format_names('write_map', 'image')} file to write",
        metavar=("OLD", "OUTPUT"),
    )
    parser.add_argument("new", type=Path, metavar="NEW", help=f"{format_names('read', 'seams')} file to be textured")
    sides = number(
        texture_size, "side of the textures in texels, or WIDTHxHEIGHT (default: 2048)", default=(2048, 2048)
    )
    add_options(parser, size=sides, **declare_options(BakeOptions))
    add_options(parser, "json")


def run(options: argparse.Namespace) -> int:
    """Read both models, bake, write, report."""
    pipeline.check_image_output(options)
    return pipeline.change_map(
        options, lambda mesh: _bake(options, mesh), source=options.new, inputs=(options.input,), read=_read
    )


def _read(_: argparse.Namespace, path: Path) -> MeshData:
    from quasiharmonic import io

    return io.read_mesh(path)


def _bake(options: argparse.Namespace, new: MeshData) -> pipeline.Changed:
    """Bake the look of the old model."""
    from quasiharmonic.apps.baking import bake

    old = _read(options, options.input)
    with pipeline.show_work(options.new):
        result = bake(old, new, **pick(options, "size", *declare_options(BakeOptions)))

    def describe(_: MeshData) -> pipeline.Account:
        facts = {**result.to_dict(), "new": str(options.new)}
        return pipeline.Account(facts, [f"wrote {options.output}: {result.summary()}"], result.success)

    return pipeline.Changed(result.mesh, describe)
