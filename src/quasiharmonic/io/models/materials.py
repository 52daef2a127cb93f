"""Materials of OBJ files: the libraries (.mtl) that they name, and a new library with a texture."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from quasiharmonic.io.lowlevel.atomic import write_whole
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.models.textures import MaterialTextures, Texture
from quasiharmonic.util.arrays import IntArray

_NAME = "map"


def with_libraries(path: str | os.PathLike[str], mesh: MeshData) -> MeshData:
    """Return the mesh with its library names changed to paths relative to the folder of ``path``.

    A name is unchanged if the library also exists beside the new file, or does not exist beside the source.
    """
    here, there = Path(mesh.source).parent, Path(path).parent

    def rename(name: str) -> str:
        if (there / name).is_file() or not (here / name).is_file():
            return name
        try:
            return os.path.relpath(here / name, there).replace(os.sep, "/")
        except ValueError:  # The library is on another drive.
            return (here / name).resolve().as_posix()

    lines = mesh.statements.split(b"\n")
    for at, line in enumerate(lines):
        names = library_names(line, here, there)
        if (new := [rename(name) for name in names]) != names:
            lines[at] = os.fsencode("mtllib " + " ".join(new))
    statements = b"\n".join(lines)
    return mesh if statements == mesh.statements else replace(mesh, statements=statements)


def library_names(line: bytes, *folders: Path) -> list[str]:
    """Return the names in an ``mtllib`` line: several names, or one with blanks if it is a file of one of the folders.

    The list is empty for other lines.
    """
    if not _names_library(line):
        return []
    name = os.fsdecode(b"".join(line.split(None, 1)[1:]).strip())
    return [name] if any((folder / name).is_file() for folder in folders) else name.split()


def companions(path: str | os.PathLike[str], texture: Texture) -> tuple[Path, Path]:
    """Return the paths of the library and of the image of an OBJ file with a texture."""
    path = Path(path)
    # In OBJ files a blank ends a name.
    stem = "_".join(path.stem.split()) + "-texture"
    return path.with_name(stem + ".mtl"), path.with_name(stem + texture.suffix)


def materials_lost(mesh: MeshData) -> list[str]:
    """Return descriptions of the materials that `write_material` drops: the file's own, and images besides colours."""
    uses = any(line.startswith(b"usemtl") for line in mesh.statements.split(b"\n"))
    lost = ["its own materials, which the image replaces"] if mesh.texture is not None and uses else []
    texture = mesh.texture
    if isinstance(texture, MaterialTextures) and (texture.metallic_roughness or texture.normal or texture.emission):
        lost.append("images besides the base colour")
    return lost


def write_material(path: str | os.PathLike[str], mesh: MeshData, *, durable: bool = True) -> MeshData:
    """Write the library and the image of an OBJ file with a texture; return the mesh with the new material instead of
    its own. ``durable`` is as in `write_whole`.
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


def label_materials(mesh: MeshData) -> tuple[IntArray, list[str | None]]:
    """Return a number for the material of each triangle, (f,), and the names of the materials; None for no material."""
    lines = mesh.statements.split(b"\n")[:-1]
    first = mesh.rings.first_triangle
    label = np.zeros(len(mesh.F), dtype=np.int64)
    names: list[str | None] = [None]
    for line, at in zip(lines, mesh.statement_faces.tolist(), strict=True):
        if line.startswith(b"usemtl"):
            names.append(line[6:].strip().decode("utf-8", "replace"))
            label[first[max(at, 0)] :] = len(names) - 1
    return label, names


def _names_library(line: bytes) -> bool:
    return line.split(None, 1)[:1] == [b"mtllib"]
