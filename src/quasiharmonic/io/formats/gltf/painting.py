"""Show new images on the surfaces of a glTF document."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

from quasiharmonic.io.formats.gltf.document import Document
from quasiharmonic.io.formats.gltf.reader import PLACES
from quasiharmonic.io.models.textures import MaterialTextures, Texture

_STRENGTH = "KHR_materials_emissive_strength"
# Root extensions that refer to no image.
_WITHOUT_IMAGES = {"KHR_lights_punctual", "KHR_materials_variants"}


def paint(document: Document, texture: Texture) -> None:
    """Show a texture on all triangles with texture coordinates.

    With `MaterialTextures`, the materials keep everything that these do not replace, except textures of extensions. The
    colours of the vertices and the images that no material uses are removed.
    """
    index = _add_image(document, texture)
    if isinstance(texture, MaterialTextures):
        _replace_materials(document, texture, index)
        _drop_unused_images(document)
        return
    look = {"baseColorTexture": {"index": index}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    materials = document.tree.setdefault("materials", [])
    materials.append({"name": "map", "pbrMetallicRoughness": look, "doubleSided": True})
    for primitive in _primitives(document):
        if PLACES in primitive["attributes"]:
            primitive["material"] = len(materials) - 1


def _add_image(document: Document, image: Texture) -> int:
    """Add an image, and return the index of its texture."""
    tree = document.tree
    textures, images = tree.setdefault("textures", []), tree.setdefault("images", [])
    textures.append({"source": len(images)})
    images.append({"bufferView": document.add_bytes(image.data), "mimeType": image.media_type})
    return len(textures) - 1


def _primitives(document: Document) -> Iterator[dict[str, Any]]:
    for mesh in document.tree["meshes"]:
        yield from mesh["primitives"]


def _replace_materials(document: Document, baked: MaterialTextures, colour: int) -> None:
    """Replace the looks of all materials on triangles with texture coordinates."""
    further = {"metallic_roughness": baked.metallic_roughness, "normal": baked.normal, "emission": baked.emission}
    index = {name: _add_image(document, image) for name, image in further.items() if image is not None}
    materials = document.tree.setdefault("materials", [])
    kept = {one.get("material") for one in _primitives(document) if PLACES not in one["attributes"]}
    made: dict[int | None, int] = {}
    for primitive in _primitives(document):
        if PLACES not in primitive["attributes"]:
            continue
        old = primitive.get("material")
        if old not in made:
            made[old] = len(materials) if old is None or old in kept else old
            entry = {} if old is None else json.loads(json.dumps(materials[old]))
            _change_look(entry, baked, colour, index)
            materials[made[old] : made[old] + 1] = [entry]
        primitive["material"] = made[old]
        primitive["attributes"].pop("COLOR_0", None)
    used = document.tree.setdefault("extensionsUsed", [])
    if _STRENGTH not in used and max(baked.emission_factor) > 1:
        used.append(_STRENGTH)
    if not used:
        del document.tree["extensionsUsed"]


def _change_look(entry: dict[str, Any], baked: MaterialTextures, colour: int, index: dict[str, int]) -> None:
    """Change a material to the baked images; ``index`` has the textures of those besides the base colour."""
    extensions = {
        name: {key: value for key, value in extension.items() if "Texture" not in key}
        for name, extension in entry.get("extensions", {}).items()
        if name != _STRENGTH
    }
    for stale in ("extensions", "normalTexture", "occlusionTexture", "emissiveTexture", "emissiveFactor"):
        entry.pop(stale, None)
    look: dict[str, Any] = {"baseColorTexture": {"index": colour}}
    if "metallic_roughness" in index:
        look["metallicRoughnessTexture"] = {"index": index["metallic_roughness"]}
        if baked.occlusion:
            entry["occlusionTexture"] = {"index": index["metallic_roughness"]}
    entry["pbrMetallicRoughness"] = look | {"metallicFactor": baked.metallic, "roughnessFactor": baked.roughness}
    if "normal" in index:
        entry["normalTexture"] = {"index": index["normal"]}
    if "emission" in index:
        entry["emissiveTexture"] = {"index": index["emission"]}
    strength = max(baked.emission_factor)
    if strength > 0:
        entry["emissiveFactor"] = [value / max(strength, 1) for value in baked.emission_factor]
    if strength > 1:
        extensions[_STRENGTH] = {"emissiveStrength": strength}
    if extensions:
        entry["extensions"] = extensions
    if baked.alpha_mode is not None:
        entry.pop("alphaCutoff", None)
        entry |= {"alphaMode": baked.alpha_mode, "doubleSided": baked.double_sided}
        if baked.alpha_mode == "MASK":
            entry["alphaCutoff"] = baked.alpha_cutoff


def _drop_unused_images(document: Document) -> None:
    """Remove textures that no material uses, images that no texture uses, and the bytes of these."""
    tree = document.tree
    if set(tree.get("extensions", {})) - _WITHOUT_IMAGES:
        return
    # References of damaged materials stay as they are.
    infos = list(_find(tree["materials"], lambda node: _is_in(node.get("index"), tree["textures"])))
    textures = _keep(tree, "textures", {info["index"] for info in infos})
    for info in infos:
        info["index"] = textures[info["index"]]
    sources = list(_find(tree["textures"], lambda node: _is_in(node.get("source"), tree["images"])))
    before = {image["bufferView"] for image in tree["images"] if "bufferView" in image}
    images = _keep(tree, "images", {node["source"] for node in sources})
    for node in sources:
        node["source"] = images[node["source"]]
    holders = list(_find(tree, lambda node: "bufferView" in node))
    dropped = before - {node["bufferView"] for node in holders}
    kept = [k for k in range(len(document.views)) if k not in dropped]
    number = {k: i for i, k in enumerate(kept)}
    for node in holders:
        node["bufferView"] = number[node["bufferView"]]
    tree["bufferViews"] = [tree["bufferViews"][k] for k in kept]
    document.views[:] = [document.views[k] for k in kept]


def _is_in(index: Any, entries: list[Any]) -> bool:
    return isinstance(index, int) and 0 <= index < len(entries)


def _keep(tree: dict[str, Any], name: str, used: set[int]) -> dict[int, int]:
    """Remove the entries of a list that are not used; return the new index of each of the others."""
    kept = sorted(used)
    tree[name] = [tree[name][k] for k in kept]
    return {k: i for i, k in enumerate(kept)}


def _find(node: Any, is_wanted: Callable[[dict[str, Any]], bool]) -> Iterator[dict[str, Any]]:
    """Yield the wanted objects in a part of a document, at any depth, except in extras."""
    if isinstance(node, list):
        for part in node:
            yield from _find(part, is_wanted)
    elif isinstance(node, dict):
        if is_wanted(node):
            yield node
        for key, part in node.items():
            if key != "extras":
                yield from _find(part, is_wanted)
