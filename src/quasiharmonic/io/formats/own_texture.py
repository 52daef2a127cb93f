"""The texture that a model's file refers to: the image of its first material that has one."""

from __future__ import annotations

import base64
import binascii
import os
from collections.abc import Iterator
from pathlib import Path

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.formats.gltf import document as gltf
from quasiharmonic.io.lowlevel.textual import read_bytes
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.models.textures import Texture, read_texture, texture_of


def own_texture(mesh: MeshData) -> Texture | None:
    """Return the colour texture of the file of a mesh: a PNG or JPEG named by its .mtl, or in its glTF or GLB.

    None if the file names none, or the image is missing or has another format.
    """
    if Path(mesh.source).suffix.lower() in (".glb", ".gltf"):
        return _of_gltf(Path(mesh.source))
    for path in _images_of_libraries(mesh):
        try:
            return read_texture(path)
        except MeshFileError:
            continue
    return None


def _images_of_libraries(mesh: MeshData) -> Iterator[Path]:
    """Yield the paths of the images in the OBJ file's material libraries."""
    folder = Path(mesh.source).parent
    for line in mesh.statements.split(b"\n"):
        keyword, _, rest = line.partition(b" ")
        if keyword != b"mtllib":
            continue
        name = os.fsdecode(rest.strip())
        names = [name] if (folder / name).is_file() else name.split()
        for library in (folder / name for name in names if (folder / name).is_file()):
            for entry in read_bytes(library).splitlines():
                words = entry.split()
                if len(words) > 1 and words[0] == b"map_Kd":
                    # Options such as -s precede the name.
                    yield library.parent / os.fsdecode(words[-1])


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
            uri = image["uri"]
            if uri.startswith("data:"):
                return texture_of(base64.b64decode(uri.partition(",")[2], validate=True))
            return texture_of(read_bytes(gltf.beside(path.parent, uri)))
    except (*gltf.DAMAGE, binascii.Error):
        # A damaged description of a material does not prevent drawing.
        return None
    return None
