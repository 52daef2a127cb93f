"""The texture that ``--texture`` adds to the written surface."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData


# The value of --texture that needs no file.
CHECKERBOARD = "checkerboard"


def read_mesh(options: argparse.Namespace, path: Path) -> MeshData:
    """Read a mesh and attach the texture that the options request.

    ValueError or OSError if the output format has no textures, a companion file cannot be written, or the image is
    missing or invalid.
    """
    from dataclasses import replace

    from quasiharmonic import io

    if options.texture is None:
        return io.read_mesh(path)
    companions = io.find_format(options.output, "write_map", "image").companions
    texture = io.checkerboard() if options.texture == CHECKERBOARD else io.read_texture(options.texture)
    if companions is not None:
        _check_companions(options, companions(options.output, texture))
    return replace(io.read_mesh(path), texture=texture)


def _check_companions(options: argparse.Namespace, companions: tuple[Path, ...]) -> None:
    """Raise ValueError if a companion file of the output would replace an input or another output."""
    from quasiharmonic import io

    taken = (getattr(options, name, None) for name in ("input", "texture", "plot", "json"))
    named = {Path(str(path)).resolve() for path in taken if path is not None}
    for path in companions:
        io.check_writable(path)
        if path.resolve() in named:
            raise ValueError(f"{path}, which goes with {options.output}, would replace another file: change -o")
