"""The appearance of a surface that was read from a glTF file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic.io.errors import printable_path
from quasiharmonic.io.formats.gltf.document import DAMAGE, Document, fault, read_uri, whole
from quasiharmonic.io.formats.gltf.reader import CarriedGltf, read_corners
from quasiharmonic.io.models.appearance import Appearance, ImageUse, NamedImage, Role, SurfaceMaterial, Wrap
from quasiharmonic.util.arrays import FloatArray, IntArray

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_PLACES = re.compile(r"TEXCOORD_(\d+)")
_TRANSFORM, _STRENGTH = "KHR_texture_transform", "KHR_materials_emissive_strength"
_WEBP = "EXT_texture_webp"
# Entries of a material and of its metallic-roughness model, besides its textures.
_ROLES: dict[Role, str] = {"occlusion": "occlusionTexture", "emission": "emissiveTexture", "normal": "normalTexture"}
_PBR_ROLES: dict[Role, str] = {"colour": "baseColorTexture", "metallic_roughness": "metallicRoughnessTexture"}


def gltf_appearance(carried: CarriedGltf) -> Appearance:
    """Return the appearance of the triangles of a glTF document; damaged materials are listed as problems."""
    reader = _MaterialReader(carried.document, carried.folder)
    primitives = [carried.document.tree["meshes"][part.mesh]["primitives"][part.primitive] for part in carried.parts]
    index = [primitive.get("material") for primitive in primitives]
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


class _MaterialReader:
    """Reads the materials of a document, and lists what is damaged."""

    def __init__(self, document: Document, folder: Path) -> None:
        self._document, self._folder = document, folder
        self._images: dict[int, NamedImage] = {}
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

    def _image(self, index: int) -> NamedImage:
        if index not in self._images:
            self._images[index] = self._read_image(index)
        return self._images[index]

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
