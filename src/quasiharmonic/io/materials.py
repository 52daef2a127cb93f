"""Materials of OBJ files: the libraries (.mtl) that they name, and one of our own with a picture."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.meshdata import MeshData
from quasiharmonic.io.textures import Texture

_NAME = "map"


def with_libraries(path: str | os.PathLike[str], mesh: MeshData) -> MeshData:
    """Name a mesh's libraries as a file at ``path`` has to, if they stand where its source names them.

    A library that is beside the new file too, or nowhere, stays as it is named.
    """

    def renamed(name: str, here: Path, there: Path) -> str:
        if (there / name).is_file() or not (here / name).is_file():
            return name
        try:
            return os.path.relpath(here / name, there).replace(os.sep, "/")
        except ValueError:  # on another drive
            return (here / name).resolve().as_posix()

    lines = mesh.statements.split(b"\n")
    if not any(map(_names_library, lines)):
        return mesh
    new = [_with_names(line, path, mesh, renamed) if _names_library(line) else line for line in lines]
    return replace(mesh, statements=b"\n".join(new))


def companions(path: str | os.PathLike[str], texture: Texture) -> tuple[Path, Path]:
    """Where the library and the picture of an OBJ file with a texture are."""
    path = Path(path)
    # Readers of OBJ files take a blank for the end of a name.
    stem = "_".join(path.stem.split()) + "-texture"
    return path.with_name(stem + ".mtl"), path.with_name(stem + texture.suffix)


def write_material(path: str | os.PathLike[str], mesh: MeshData, *, durable: bool = True) -> MeshData:
    """Write the library and the picture that go with an OBJ file, and return the mesh that names them.

    Parameters
    ----------
    path : str or path-like
        The OBJ file.
    mesh : MeshData
        With a texture; materials of its own are left out.
    durable : bool
        As for `write_whole`.

    Returns
    -------
    MeshData
        To be written at ``path``.
    """
    assert mesh.texture is not None
    library, picture = companions(path, mesh.texture)
    text = f"newmtl {_NAME}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {picture.name}\n"
    write_whole(picture, mesh.texture.data, durable=durable)
    write_whole(library, text.encode(), durable=durable)
    lines = mesh.statements.split(b"\n")[:-1]
    kept = [i for i, line in enumerate(lines) if not _names_library(line) and not line.startswith(b"usemtl")]
    head = sum(1 for i in kept if mesh.statement_faces[i] < 0)
    new = [lines[i] for i in kept]
    at = mesh.statement_faces[kept].tolist()
    new[head:head] = [f"mtllib {library.name}".encode(), f"usemtl {_NAME}".encode()]
    at[head:head] = [-1, 0]
    return replace(
        mesh, statements=b"".join(line + b"\n" for line in new), statement_faces=np.array(at, dtype=np.int64)
    )


def _names_library(line: bytes) -> bool:
    return line.split(None, 1)[:1] == [b"mtllib"]


def _with_names(
    line: bytes, path: str | os.PathLike[str], mesh: MeshData, change: Callable[[str, Path, Path], str]
) -> bytes:
    """A ``mtllib`` line with its names changed: several, or a single one with blanks."""
    here, there = Path(mesh.source).parent, Path(path).parent
    rest = os.fsdecode(line.split(None, 1)[1].strip()) if len(line.split(None, 1)) > 1 else ""
    whole = (here / rest).is_file() or (there / rest).is_file()
    names = [rest] if whole else rest.split()
    new = [change(name, here, there) for name in names]
    return line if new == names else os.fsencode("mtllib " + " ".join(new))
