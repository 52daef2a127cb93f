"""Materials of glTF documents: read the appearance of a surface, and show new images on it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic.io.errors import printable_path
from quasiharmonic.io.formats.gltf.document import DAMAGE, Document, fault, find_objects, read_uri, whole
from quasiharmonic.io.formats.gltf.reader import PLACES, CarriedGltf, read_corners
from quasiharmonic.io.models.appearance import Appearance, ImageUse, NamedImage, Role, SurfaceMaterial, Wrap
from quasiharmonic.io.models.textures import MaterialTextures, Texture
from quasiharmonic.util.arrays import FloatArray, IntArray

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_PLACES = re.compile(r"TEXCOORD_(\d+)")
_TRANSFORM, _STRENGTH = "KHR_texture_transform", "KHR_materials_emissive_strength"
_WEBP = "EXT_texture_webp"
# Entries of a material and of its metallic-roughness model, besides its textures.
_ROLES: dict[Role, str] = {"occlusion": "occlusionTexture", "emission": "emissiveTexture", "normal": "normalTexture"}
_PBR_ROLES: dict[Role, str] = {"colour": "baseColorTexture", "metallic_roughness": "metallicRoughnessTexture"}
# Root extensions that refer to no image.
_WITHOUT_IMAGES = {"KHR_lights_punctual", "KHR_materials_variants"}


def gltf_appearance(carried: CarriedGltf) -> Appearance:
    """Return the appearance of the triangles of a glTF document; damaged materials are listed as problems."""
    reader = _MaterialReader(carried.document, carried.folder)
    index = [part.entry(carried.document).get("material") for part in carried.parts]
    used = list(dict.fromkeys(index))
    of_triangle: IntArray = np.concatenate(
        [np.full(part.end - part.begin, used.index(k)) for part, k in zip(carried.parts, index, strict=True)]
    )
    names = {name for pool in carried.pools for name in pool.attributes}
    coordinates = {
        int(found[1]): read_corners(carried, name, 2)
        for name in sorted(names)
        if (found := _PLACES.fullmatch(name)) is not None
    }
    colours: FloatArray | None = None
    if "COLOR_0" in names:
        colours = read_corners(carried, "COLOR_0", None)
        opaque = np.ones((*colours.shape[:2], 4 - colours.shape[2]))
        colours = np.nan_to_num(np.concatenate([colours, opaque], axis=2), nan=1.0)
    materials = tuple(reader.read(k) for k in used)
    if "KHR_materials_variants" in carried.document.tree.get("extensions", {}):
        reader.problems.append("variants of materials are not baked, and keep their textures")
    return Appearance(materials, of_triangle, coordinates, colours, tuple(dict.fromkeys(reader.problems)))


def first_colour_image(carried: CarriedGltf) -> bytes | None:
    """Return the image of the first material that has a base colour texture; None if it cannot be read."""
    reader = _MaterialReader(carried.document, carried.folder)
    for k in range(len(carried.document.tree.get("materials", []))):
        if (use := reader.read(k).textures.get("colour")) is not None:
            return use.image.data
    return None


class _MaterialReader:
    """Reads the materials of a document, and lists what is damaged."""

    def __init__(self, document: Document, folder: Path) -> None:
        self._document, self._folder = document, folder
        self._image = cache(self._read_image)
        self.problems: list[str] = []

    def read(self, index: int | None) -> SurfaceMaterial:
        """Return a material; the default material for None, or if it is damaged."""
        if index is None:
            return SurfaceMaterial(metallic=1.0, double_sided=False)
        try:
            return self._material(self._document.tree["materials"][index])
        except DAMAGE as error:
            self.problems.append(f"material {index} is damaged: {fault(error)}")
            return SurfaceMaterial(metallic=1.0, double_sided=False)

    def _material(self, entry: dict[str, Any]) -> SurfaceMaterial:
        name = str(entry.get("name", ""))
        pbr, extensions = entry.get("pbrMetallicRoughness", {}), entry.get("extensions", {})
        strength = float(extensions.get(_STRENGTH, {}).get("emissiveStrength", 1.0))
        textures: dict[Role, ImageUse] = {}
        for within, roles in ((pbr, _PBR_ROLES), (entry, _ROLES)):
            for role, key in roles.items():
                if key in within:
                    try:
                        textures[role] = self._use(within[key])
                    except DAMAGE as error:
                        self.problems.append(f"{key} of material {printable_path(name)} is damaged: {fault(error)}")
        others = sorted(set(extensions) - {_STRENGTH})
        if others and any("Texture" in key for extension in others for key in extensions[extension]):
            self.problems.append(f"textures of {', '.join(map(printable_path, others))} are not baked")
        return SurfaceMaterial(
            name,
            _numbers(pbr.get("baseColorFactor"), (1.0, 1.0, 1.0, 1.0)),
            float(pbr.get("metallicFactor", 1.0)),
            float(pbr.get("roughnessFactor", 1.0)),
            tuple(strength * value for value in _numbers(entry.get("emissiveFactor"), (0.0, 0.0, 0.0))),
            float(entry.get("normalTexture", {}).get("scale", 1.0)),
            float(entry.get("occlusionTexture", {}).get("strength", 1.0)),
            str(entry.get("alphaMode", "OPAQUE")),
            float(entry.get("alphaCutoff", 0.5)),
            bool(entry.get("doubleSided", False)),
            textures,
        )

    def _use(self, info: dict[str, Any]) -> ImageUse:
        """Return what a reference to a texture says."""
        tree = self._document.tree
        texture = tree["textures"][whole(info["index"])]
        moved = info.get("extensions", {}).get(_TRANSFORM, {})
        channel = whole(moved.get("texCoord", info.get("texCoord", 0)))
        wrap: list[Wrap] = ["repeat", "repeat"]
        if "sampler" in texture:
            sampler = tree["samplers"][whole(texture["sampler"])]
            wrap = [_WRAPS[sampler.get(key, 10497)] for key in ("wrapS", "wrapT")]
        angle, scale = float(moved.get("rotation", 0.0)), _numbers(moved.get("scale"), (1.0, 1.0))
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        offset = np.array(_numbers(moved.get("offset"), (0.0, 0.0)))
        source = texture["source"] if "source" in texture else texture["extensions"][_WEBP]["source"]
        transform = np.column_stack([turn * scale, offset])
        return ImageUse(self._image(whole(source)), channel, (wrap[0], wrap[1]), transform)

    def _read_image(self, index: int) -> NamedImage:
        image = self._document.tree["images"][index]
        uri = image.get("uri", "")
        name = str(image.get("name") or ("" if uri.startswith("data:") else uri) or f"image {index}")
        try:
            if "bufferView" in image:
                return NamedImage(name, bytes(self._document.views[whole(image["bufferView"])]))
            return NamedImage(name, read_uri(self._folder, uri))
        except DAMAGE:
            return NamedImage(name, None)


def _numbers(values: Any, default: tuple[float, ...]) -> tuple[float, ...]:
    """Return as many finite numbers as the default has; ValueError for anything else."""
    if values is None:
        return default
    found = tuple(float(value) for value in values)
    if len(found) != len(default) or not np.isfinite(found).all():
        raise ValueError(f"{len(default)} numbers are needed")
    return found


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
    infos = list(find_objects(tree["materials"], lambda node: _is_in(node.get("index"), tree["textures"])))
    textures = _keep_used(tree, "textures", {info["index"] for info in infos})
    for info in infos:
        info["index"] = textures[info["index"]]
    sources = list(find_objects(tree["textures"], lambda node: _is_in(node.get("source"), tree["images"])))
    before = {image["bufferView"] for image in tree["images"] if "bufferView" in image}
    images = _keep_used(tree, "images", {node["source"] for node in sources})
    for node in sources:
        node["source"] = images[node["source"]]
    holders = list(find_objects(tree, lambda node: "bufferView" in node))
    dropped = before - {node["bufferView"] for node in holders}
    kept = [k for k in range(len(document.views)) if k not in dropped]
    number = {k: i for i, k in enumerate(kept)}
    for node in holders:
        node["bufferView"] = number[node["bufferView"]]
    tree["bufferViews"] = [tree["bufferViews"][k] for k in kept]
    document.views[:] = [document.views[k] for k in kept]


def _is_in(index: Any, entries: list[Any]) -> bool:
    return isinstance(index, int) and 0 <= index < len(entries)


def _keep_used(tree: dict[str, Any], name: str, used: set[int]) -> dict[int, int]:
    """Remove the entries of a list that are not used; return the new index of each of the others."""
    kept = sorted(used)
    tree[name] = [tree[name][k] for k in kept]
    return {k: i for i, k in enumerate(kept)}
