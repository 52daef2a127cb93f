"""The texture that a model's file refers to: the image of its first material that has one."""

from __future__ import annotations

import base64
import binascii
import os
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.formats.gltf import document as gltf
from quasiharmonic.io.formats.gltf.reader import CarriedGltf
from quasiharmonic.io.lowlevel.textual import read_bytes
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.models.textures import Texture, read_texture, texture_of
from quasiharmonic.util.untrusted import beside


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


def texture_names(mesh: MeshData) -> list[str]:
    """Return the names of the images that the materials of a mesh's file show, in order, each once."""
    if Path(mesh.source).suffix.lower() not in (".glb", ".gltf"):
        return list(dict.fromkeys(path.name for path in _images_of_libraries(mesh)))
    if not isinstance(mesh.carried, CarriedGltf):
        return []
    images = mesh.carried.document.tree.get("images", [])
    named = [image.get("name") or image.get("uri") for image in images if isinstance(image, dict)]
    named = [name if isinstance(name, str) and not name.startswith("data:") else None for name in named]
    return list(dict.fromkeys(name or f"image {k}" for k, name in enumerate(named)))


def _images_of_libraries(mesh: MeshData) -> Iterator[Path]:
    """Yield the paths of the images in the OBJ file's material libraries; all are in the folder of the file."""
    folder = Path(mesh.source).parent
    for line in mesh.statements.split(b"\n"):
        keyword, _, rest = line.partition(b" ")
        if keyword != b"mtllib":
            continue
        name = os.fsdecode(rest.strip())
        names = [name] if (folder / name).is_file() else name.split()
        for library in (folder / name for name in names if _is_beside(folder, name) and (folder / name).is_file()):
            within = library.parent.relative_to(folder)
            for entry in read_bytes(library).splitlines():
                words = entry.split()
                if len(words) > 1 and words[0] == b"map_Kd":
                    # Options such as -s precede the name.
                    image = os.fsdecode(words[-1])
                    if _is_beside(folder, str(within / image)):
                        yield folder / within / image


def _is_beside(folder: Path, name: str) -> bool:
    """Whether a name is that of a file in a folder or below it."""
    try:
        beside(folder, quote(name))
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
            uri = image["uri"]
            if uri.startswith("data:"):
                return texture_of(base64.b64decode(uri.partition(",")[2], validate=True))
            return texture_of(read_bytes(beside(path.parent, uri)))
    except (*gltf.DAMAGE, binascii.Error):
        # A damaged description of a material does not prevent drawing.
        return None
    return None
