"""Options that put a picture on the surface that is written."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData


def add_options(parser: argparse._ActionsContainer) -> None:
    """``--material`` and ``--picture``."""
    parser.add_argument(
        "--material",
        action="store_true",
        help="write the file with a checkerboard on it: an OBJ with an .mtl and a .png beside it, a GLB with all in it",
    )
    parser.add_argument("--picture", type=Path, metavar="FILE", help="the same with an image, PNG or JPEG")


def read_mesh(options: argparse.Namespace, path: Path) -> MeshData:
    """Read a mesh, and have it written with the picture that the options ask for.

    Raises
    ------
    ValueError, OSError
        When the output cannot have a picture, a file beside it cannot be written, the picture is missing or none.
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
    """Refuse to write over what the user handed in, or asked for otherwise."""
    from quasiharmonic import io

    taken = (getattr(options, name, None) for name in ("input", "picture", "plot", "json"))
    named = {Path(str(path)).resolve() for path in taken if path is not None}
    for path in companions:
        io.check_writable(path)
        if path.resolve() in named:
            raise ValueError(f"{path}, which goes with {options.output}, would replace another file: change -o")
