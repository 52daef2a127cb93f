"""The appearance of a model as its file has it: glTF materials, OBJ material libraries, or colours of vertices.

The texture of a file is the image of its first material that has one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any
from urllib.parse import quote

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.formats.gltf import document as gltf
from quasiharmonic.io.formats.gltf.looks import find_objects, gltf_appearance
from quasiharmonic.io.formats.gltf.reader import CarriedGltf
from quasiharmonic.io.models.appearance import (
    Appearance,
    ImageUse,
    NamedImage,
    Role,
    SurfaceMaterial,
    Wrap,
    library_names,
    plain_appearance,
)
from quasiharmonic.io.models.meshdata import MeshData, colours_of
from quasiharmonic.io.models.textures import Texture, texture_of
from quasiharmonic.io.untrusted import read_bytes, resolve_beside

# Entries of material libraries about images that `read_appearance` reads.
_IMAGES: dict[bytes, Role] = {b"map_Kd": "colour", b"map_Ke": "emission"}
_GLTF = ".glb", ".gltf"
# Keywords of images in material libraries.
_IMAGE_KEYWORD = re.compile(rb"bump|decal|disp|norm|map_(?!aat$).*", re.IGNORECASE | re.DOTALL)


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
    folder, data = Path(mesh.source).parent, None
    if is_beside(folder, str(name)):
        with suppress(MeshFileError):
            data = read_bytes(folder / name)
    return NamedImage(str(name), data)


def own_texture(mesh: MeshData) -> Texture | None:
    """Return the colour texture of the file of a mesh: a PNG or JPEG named by its .mtl, or in its glTF or GLB.

    None if the file names none, or the image is missing or has another format. No file is opened outside the folder of
    the mesh's file.
    """
    if Path(mesh.source).suffix.lower() in _GLTF:
        return _of_gltf(Path(mesh.source))
    for words, within in library_entries(mesh):
        if words[0] == b"map_Kd":
            data = _read_image(mesh, within / os.fsdecode(words[-1])).data
            if data is not None and (texture := texture_of(data)) is not None:
                return texture
    return None


def texture_names(mesh: MeshData) -> list[str]:
    """Return the names of the images that the materials of a mesh's file use, in order and without repetition.

    No image is opened.
    """
    if Path(mesh.source).suffix.lower() in _GLTF:
        tree = mesh.carried.document.tree if isinstance(mesh.carried, CarriedGltf) else {}
        try:
            return list(dict.fromkeys(_names_in_gltf(tree)))
        except gltf.DAMAGE:
            # A damaged description of a material does not prevent other work.
            return []
    textures = (os.fsdecode(words[-1]) for words, _ in library_entries(mesh) if _IMAGE_KEYWORD.fullmatch(words[0]))
    # Names in libraries can have the separators of any system.
    return list(dict.fromkeys(PureWindowsPath(name).name for name in textures))


def library_entries(mesh: MeshData) -> Iterator[tuple[list[bytes], Path]]:
    """Yield the entries of the OBJ file's material libraries: at least two words, and the folder of the library.

    Only libraries in the folder of the file are opened. Their folders are relative to it. The last word of an entry
    about an image is its name; options such as -s precede it.
    """
    folder = Path(mesh.source).parent
    for line in mesh.statements.split(b"\n"):
        names = [name for name in library_names(line, folder) if is_beside(folder, name)]
        for library in (folder / name for name in names if (folder / name).is_file()):
            within = library.parent.relative_to(folder)
            for entry in read_bytes(library).splitlines():
                words = entry.split()
                if len(words) > 1:
                    yield words, within


def _names_in_gltf(tree: dict[str, Any]) -> Iterator[str]:
    """Yield the names of the images that the materials of a glTF document show by the first texture coordinates."""
    for info in find_objects(tree.get("materials", []), lambda node: "index" in node):
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        if moved.get("texCoord", info.get("texCoord", 0)) != 0:
            continue
        texture = tree["textures"][info["index"]]
        # Extensions name images of other formats.
        for variant in (texture, *texture.get("extensions", {}).values()):
            if "source" in variant:
                image = tree["images"][variant["source"]]
                name = image.get("name") or image.get("uri", "data:")
                yield f"image {variant['source']}" if name.startswith("data:") else name


def is_beside(folder: Path, name: str) -> bool:
    """Whether a name is that of a file in a folder or below it."""
    try:
        resolve_beside(folder, quote(name))
    except ValueError:
        return False
    return True


def _of_gltf(path: Path) -> Texture | None:
    """Return the base colour texture of a glTF file."""
    document = gltf.load(path)
    tree = document.tree
    try:
        for material in tree.get("materials", []):
            colour = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
            if colour is None:
                continue
            image = tree["images"][tree["textures"][colour["index"]]["source"]]
            if "bufferView" in image:
                return texture_of(bytes(document.views[image["bufferView"]]))
            return texture_of(gltf.read_uri(path.parent, image["uri"]))
    except gltf.DAMAGE:
        # A damaged description of a material does not prevent drawing.
        return None
    return None
