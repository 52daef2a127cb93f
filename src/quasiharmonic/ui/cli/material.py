"""Options that add a texture to the written surface."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData


def add_options(parser: argparse._ActionsContainer) -> None:
    """Add ``--material`` and ``--picture``."""
    parser.add_argument(
        "--material",
        action="store_true",
        help="write the file with a checkerboard on it: an OBJ with an .mtl and a .png beside it, a GLB with all in it",
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="the same with an image, PNG or JPEG")


def read_mesh(options: argparse.Namespace, path: Path) -> MeshData:
    """Read a mesh and attach the texture that the options request.

    Raises
    ------
    ValueError, OSError
        If the output format has no textures, a companion file cannot be written, or the image is missing or invalid.
    """
    from dataclasses import replace

    from quasiharmonic import io

    if options.picture is None and not options.material:
        return io.read_mesh(path)
    suffix = options.output.suffix.lower()
    if suffix not in io.TEXTURED:
        raise ValueError(f"{options.output}: pictures go with {', '.join(io.TEXTURED)}, and {suffix} has room for none")
    texture = io.checkerboard() if options.picture is None else io.read_texture(options.picture)
    if suffix == ".obj":
        _check_companions(options, io.companions(options.output, texture))
    return replace(io.read_mesh(path), texture=texture)


def _check_companions(options: argparse.Namespace, companions: tuple[Path, Path]) -> None:
    """Raise ValueError if a companion file of the output would replace an input or another output."""
    from quasiharmonic import io

    taken = (getattr(options, name, None) for name in ("input", "picture", "plot", "json"))
    named = {Path(str(path)).resolve() for path in taken if path is not None}
    for path in companions:
        io.check_writable(path)
        if path.resolve() in named:
            raise ValueError(f"{path}, which goes with {options.output}, would replace another file: change -o")
