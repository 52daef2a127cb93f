"""The material library and the images of an OBJ file whose mesh was read from a glTF file."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from quasiharmonic.io.formats.gltf.looks import gltf_appearance
from quasiharmonic.io.formats.gltf.reader import CarriedGltf, material_statements
from quasiharmonic.io.models.appearance import Role, SurfaceMaterial
from quasiharmonic.io.models.materials import companions
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.models.textures import Texture, texture_of

# Images that a library can name, and their keywords. Those of metallic-roughness are two images in libraries.
_KEYWORDS: dict[Role, str] = {"colour": "map_Kd", "emission": "map_Ke", "normal": "norm"}


def make_library(path: str | os.PathLike[str], mesh: MeshData) -> tuple[MeshData, dict[Path, bytes]]:
    """Return a mesh of a glTF file with statements that name a material library, and the files to write beside it.

    Other meshes, and those with a texture of their own, are returned without files. Images other than PNG and JPEG, and
    those of further texture coordinates, are left out.
    """
    carried = _find_carried(mesh)
    if carried is None:
        return mesh, {}
    images, lines = dict[Path, bytes](), []
    library = companions(path, Texture(b"", "", ""))[0]
    named = {name: material for name, material in zip(*_read_materials(carried), strict=True) if name}
    for name, material in named.items():
        lines += [b"newmtl " + name, *(line.encode() for line in _describe(material))]
        for role, keyword in _KEYWORDS.items():
            if (picture := _find_image(material, role)) is None:
                continue
            file = next((known for known, data in images.items() if data == picture.data), None)
            if file is None:
                file = library.with_name(f"{library.stem}-{len(images)}{picture.suffix}")
                images[file] = picture.data
            lines.append(os.fsencode(f"{keyword} {file.name}"))
    if not named:
        return mesh, {}
    head, at = [os.fsencode(f"mtllib {library.name}")], [-1]
    if b"usemtl " not in mesh.statements:
        head, at = [*head, b"usemtl " + next(iter(named))], [-1, 0]
    made = replace(
        mesh,
        statements=b"".join(line + b"\n" for line in head) + mesh.statements,
        statement_faces=np.concatenate([at, mesh.statement_faces]),
    )
    return made, {library: b"".join(line + b"\n" for line in lines), **images}


def list_lost_looks(mesh: MeshData) -> list[str] | None:
    """Return what the library does not have of the materials of a glTF file; None for other meshes."""
    if (carried := _find_carried(mesh)) is None:
        return None
    materials = _read_materials(carried)[1]
    uses = [(role, one, use) for one in materials for role, use in one.textures.items()]
    lost = {role for role, one, _ in uses if role not in _KEYWORDS or _find_image(one, role) is None}
    listed = [f"images of materials for {role.replace('_', '-')}" for role in sorted(lost)]
    # Few readers of libraries know the options of images.
    return listed + ["images that do not repeat"] * any(use.wrap != ("repeat", "repeat") for *_, use in uses)


def _find_carried(mesh: MeshData) -> CarriedGltf | None:
    """Return the glTF file of a mesh that still has its triangles, and no texture of its own."""
    carried = mesh.carried
    fits = mesh.texture is None and isinstance(carried, CarriedGltf) and carried.fits(mesh)
    return carried if fits and isinstance(carried, CarriedGltf) else None


def _read_materials(carried: CarriedGltf) -> tuple[list[bytes], tuple[SurfaceMaterial, ...]]:
    """Return the names of the materials that triangles use, empty for the default one, and these materials."""
    tree = carried.document.tree
    used = dict.fromkeys(tree["meshes"][one.mesh]["primitives"][one.primitive].get("material") for one in carried.parts)
    statements = material_statements(tree)
    names = [b"" if k is None else statements[k].split(None, 1)[1].strip() for k in used]
    return names, gltf_appearance(carried).materials


def _find_image(material: SurfaceMaterial, role: Role) -> Texture | None:
    """Return an image that a library can name."""
    use = material.textures.get(role)
    return None if use is None or use.channel or use.image.data is None else texture_of(use.image.data)


def _describe(material: SurfaceMaterial) -> list[str]:
    """Return the entries of a library on the factors of a material."""
    red, green, blue, opacity = material.colour
    entries = [f"Kd {red!r} {green!r} {blue!r}", f"Pr {material.roughness!r}", f"Pm {material.metallic!r}"]
    if material.alpha_mode != "OPAQUE":
        entries.append(f"d {opacity!r}")
    if any(material.emission):
        entries.append("Ke " + " ".join(map(repr, material.emission)))
    return entries
