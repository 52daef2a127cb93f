"""The appearance of a model as its file has it: glTF materials, OBJ material libraries, or colours of vertices.

The texture of a file is the image of its first material that has one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np

from quasiharmonic.io.errors import MeshFileError, printable_path
from quasiharmonic.io.formats.gltf.document import DAMAGE, find_objects
from quasiharmonic.io.formats.gltf.looks import first_colour_image, gltf_appearance
from quasiharmonic.io.formats.gltf.reader import CarriedGltf, read_channel
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
from quasiharmonic.io.untrusted import is_number, read_bytes, resolve_beside

# Entries of material libraries about images that `read_appearance` reads.
_IMAGES: dict[bytes, Role] = {b"map_Kd": "colour", b"map_Ke": "emission"}
# Options of images in material libraries by their largest number of values. All values are required, except those of
# the first three, which are one to three numbers.
_IMAGE_OPTIONS = {
    **{b"-s": 3, b"-o": 3, b"-t": 3, b"-mm": 2},
    **dict.fromkeys(
        (b"-bm", b"-boost", b"-texres", b"-imfchan", b"-type", b"-blendu", b"-blendv", b"-cc", b"-clamp"), 1
    ),
}
# Those that change an image and are not read.
_LOST_OPTIONS = b"-t", b"-mm", b"-imfchan", b"-type"
# Entries of materials that are not read, although they change how a surface looks; those that are numbers unless zero.
_LOST_ENTRIES = (b"map_", b"norm", b"bump", b"disp", b"decal", b"refl")
_LOST_NUMBERS = b"Pc", b"Pcr", b"Ps", b"aniso", b"anisor"
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
    if mesh.carried is not None and mesh.carried.fits(mesh):
        problems += tuple(f"{name} is not baked" for name in mesh.carried.unread_looks())
    colours = colours_of(mesh)
    if mesh.extra is not None and colours is None and mesh.extra.shape[1] in (3, 4):
        problems += ("colours of vertices are not baked: some are missing, or not from 0 to 1",)
    return plain_appearance(mesh, materials, colours, problems)


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
            elif keyword == b"Pr":
                found[name] = replace(material, roughness=float(words[1]))
            elif keyword == b"Pm":
                found[name] = replace(material, metallic=float(words[1]))
            elif keyword in _IMAGES:
                use, lost = _use_image(mesh, words, within)
                found[name] = replace(material, textures={**material.textures, _IMAGES[keyword]: use})
                problems += [f"{option} of {keyword.decode()} of material {name} is not baked" for option in lost]
            elif keyword.startswith(_LOST_ENTRIES) or (keyword in _LOST_NUMBERS and any(map(float, words[1:]))):
                problems.append(f"{keyword.decode('utf-8', 'replace')} of material {name} is not baked")
        except ValueError:
            problems.append(f"{keyword.decode('utf-8', 'replace')} of material {name} is not a number")
    return found, tuple(problems)


def _use_image(mesh: MeshData, words: Sequence[bytes], within: Path) -> tuple[ImageUse, list[str]]:
    """Return the image of an entry of a library in the folder ``within``, and the options that are not read."""
    options, name = _image_options(words)
    scale, offset = np.ones(2), np.zeros(2)
    for option, numbers in ((b"-s", scale), (b"-o", offset)):
        given = options.get(option, [])[:2]
        numbers[: len(given)] = list(map(float, given))
    # Vertical coordinates of libraries point upwards.
    transform = np.array([[scale[0], 0, offset[0]], [0, scale[1], 1 - scale[1] - offset[1]]])
    wrap: Wrap = "clamp" if options.get(b"-clamp") == [b"on"] else "repeat"
    lost = [option.decode() for option in _LOST_OPTIONS if option in options]
    return ImageUse(_read_image(mesh, within / name), wrap=(wrap, wrap), transform=transform), lost


def _image_options(words: Sequence[bytes]) -> tuple[dict[bytes, list[bytes]], str]:
    """Return the options of an entry about an image, and the name of the image, which may have blanks."""
    options: dict[bytes, list[bytes]] = {}
    at = 1
    while at < len(words) - 1 and (most := _IMAGE_OPTIONS.get(words[at])):
        end = at + 1
        while end < len(words) - 1 and end <= at + most and (most < 3 or is_number(words[end])):
            end += 1
        options[words[at]] = list(words[at + 1 : end])
        at = end
    # Unknown options have an unknown number of values.
    name = os.fsdecode(words[-1] if words[at].startswith(b"-") else b" ".join(words[at:]))
    # Some programs quote names, or write the separators of Windows.
    return options, name.strip('"').replace("\\", "/")


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
    if isinstance(mesh.carried, CarriedGltf):
        data = first_colour_image(mesh.carried)
        return None if data is None else texture_of(data)
    for words, within in library_entries(mesh):
        if words[0] == b"map_Kd":
            data = _read_image(mesh, within / _image_options(words)[1]).data
            if data is not None and (texture := texture_of(data)) is not None:
                return texture
    return None


def texture_names(mesh: MeshData, channel: int = 0) -> list[str]:
    """Return the names of the images that the materials of a mesh's file use, in order and without repetition.

    Only images that a channel of texture coordinates places are listed. No image is opened.
    """
    if isinstance(mesh.carried, CarriedGltf):
        try:
            return list(dict.fromkeys(_names_in_gltf(mesh.carried.document.tree, channel)))
        except DAMAGE:
            # A damaged description of a material does not prevent other work.
            return []
    if channel:
        return []
    textures = (_image_options(words)[1] for words, _ in library_entries(mesh) if _IMAGE_KEYWORD.fullmatch(words[0]))
    return list(dict.fromkeys(PurePosixPath(name).name for name in textures))


def unfitting_textures(before: MeshData, after: MeshData) -> list[str]:
    """Return the names of the file's images that do not fit, because their texture coordinates changed."""
    if after.texture is not None:
        return []
    channel = len(after.lower_maps)
    old = before.corner_uv if not channel else None
    if channel and isinstance(before.carried, CarriedGltf):
        old = read_channel(before.carried, channel)
    same = old is None or np.array_equal(old, after.corner_uv, equal_nan=True)
    return [] if same else texture_names(before, channel)


def describe_unfitting(names: Sequence[str]) -> str:
    """Return a sentence on the images that `unfitting_textures` lists."""
    return f"the new coordinates do not fit the textures of the file: {', '.join(map(printable_path, names))}"


def library_entries(mesh: MeshData) -> Iterator[tuple[list[bytes], Path]]:
    """Yield the entries of the OBJ file's material libraries: at least two words, and the folder of the library.

    Only libraries in the folder of the file are opened. Their folders are relative to it.
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


def _names_in_gltf(tree: dict[str, Any], channel: int) -> Iterator[str]:
    """Yield the names of the images that the materials of meshes show by a channel of texture coordinates."""
    used = {node["material"] for node in find_objects(tree["meshes"], lambda node: "material" in node)}
    materials = [material for k, material in enumerate(tree.get("materials", [])) if k in used]
    for info in find_objects(materials, lambda node: "index" in node):
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        if moved.get("texCoord", info.get("texCoord", 0)) != channel:
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
