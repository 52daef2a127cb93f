"""The appearance of a model as its file has it: glTF materials, OBJ material libraries, or colours of vertices."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.formats.gltf.looks import gltf_appearance
from quasiharmonic.io.formats.gltf.reader import CarriedGltf
from quasiharmonic.io.formats.own_texture import is_beside, library_entries
from quasiharmonic.io.formats.vertex_data import colours_of
from quasiharmonic.io.lowlevel.textual import read_bytes
from quasiharmonic.io.models.appearance import (
    Appearance,
    ImageUse,
    NamedImage,
    Role,
    SurfaceMaterial,
    Wrap,
    plain_appearance,
)
from quasiharmonic.io.models.meshdata import MeshData

# Entries of material libraries about images that `read_appearance` reads.
_IMAGES: dict[bytes, Role] = {b"map_Kd": "colour", b"map_Ke": "emission"}


def read_appearance(mesh: MeshData) -> Appearance:
    """Return how the surface of a mesh looks; the mesh is as `read_mesh` returned it.

    Colours of the vertices are linear in glTF files, and sRGB in others. Images are read from the folder of the file
    only. What is damaged is listed as a problem, and has its default.
    """
    if isinstance(mesh.carried, CarriedGltf) and mesh.carried.fits(mesh):
        return gltf_appearance(mesh.carried)
    materials, problems = _read_libraries(mesh)
    return plain_appearance(mesh, materials, colours_of(mesh), problems)


def _read_libraries(mesh: MeshData) -> tuple[dict[str, SurfaceMaterial], tuple[str, ...]]:
    """Return the materials in the libraries of an OBJ file by name, and problems."""
    found: dict[str, SurfaceMaterial] = {}
    problems: list[str] = []
    name = ""
    for words, within in library_entries(mesh):
        keyword = words[0]
        if keyword == b"newmtl":
            name = b" ".join(words[1:]).decode("utf-8", "replace")
            found[name] = SurfaceMaterial(name)
            continue
        material = found.get(name)
        if material is None:
            continue
        try:
            if keyword == b"Kd":
                found[name] = replace(material, colour=(*map(float, words[1:4]), material.colour[3]))
            elif keyword in (b"d", b"Tr"):
                opacity = float(words[-1]) if keyword == b"d" else 1 - float(words[-1])
                mode = "BLEND" if opacity < 1 else "OPAQUE"
                found[name] = replace(material, colour=(*material.colour[:3], opacity), alpha_mode=mode)
            elif keyword == b"Ke":
                found[name] = replace(material, emission=tuple(map(float, words[1:4])))
            elif keyword in _IMAGES:
                image = _read_image(mesh, within / os.fsdecode(words[-1]))
                wrap: Wrap = "clamp" if b"-clamp on" in b" ".join(words) else "repeat"
                use = ImageUse(image, wrap=(wrap, wrap))
                found[name] = replace(material, textures={**material.textures, _IMAGES[keyword]: use})
            elif keyword.startswith((b"map_", b"norm", b"bump")):
                problems.append(f"{keyword.decode('utf-8', 'replace')} of material {name} is not baked")
        except ValueError:
            problems.append(f"{keyword.decode('utf-8', 'replace')} of material {name} is not a number")
    return found, tuple(problems)


def _read_image(mesh: MeshData, name: Path) -> NamedImage:
    """Return an image that a library in the folder of the mesh's file names."""
    folder = Path(mesh.source).parent
    if not is_beside(folder, str(name)):
        return NamedImage(str(name), None)
    try:
        return NamedImage(str(name), read_bytes(folder / name))
    except MeshFileError:
        return NamedImage(str(name), None)
