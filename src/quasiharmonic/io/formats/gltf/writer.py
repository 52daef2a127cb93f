"""Write glTF: the file that was read with a new map, or a new file; vertices are split along seams."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.errors import check_path
from quasiharmonic.io.formats.gltf.document import Document, embed_pictures, find_objects
from quasiharmonic.io.formats.gltf.looks import paint
from quasiharmonic.io.formats.gltf.reader import PLACES, CarriedGltf, VertexPool
from quasiharmonic.io.models.appearance import label_materials, materials_lost
from quasiharmonic.io.models.meshdata import MeshData, colours_of, normals_of
from quasiharmonic.io.models.textures import MaterialTextures
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, count_of

_EXACT = 2.0**-53


def write_gltf(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write a mesh as a glTF 2.0 file, binary if its name ends in .glb, atomically.

    Texture coordinates and new positions are in single precision. Vertices keep their order. A vertex with several
    texture coordinates gets copies at the end of its pool. A mesh that was read from a glTF file keeps all other data
    of that file, unchanged where no vertex was split; images from files beside it are embedded. For other meshes, each
    run of faces with one material becomes a primitive, and polygons are written as triangles.

    Raises
    ------
    ValueError
        If a number exceeds single precision, or the data exceed the limits of glTF.
    OutputError
        If the file cannot be written. An existing file is then unchanged.
    """
    carried = mesh.carried
    if isinstance(carried, CarriedGltf) and carried.fits(mesh):
        document = _replace_map(carried, mesh)
        embed_pictures(document, carried.folder)
    else:
        document = _make_document(mesh)
    if mesh.texture is not None:
        paint(document, mesh.texture)
    check_path("path", path)
    write_whole(path, document.encode(binary=Path(path).suffix.lower() == ".glb"))


def not_in_gltf(mesh: MeshData) -> list[str]:
    """Return descriptions of the mesh data that a glTF file will not contain."""
    carried = mesh.carried
    lost = [] if isinstance(mesh.texture, MaterialTextures) else materials_lost(mesh)
    if isinstance(carried, CarriedGltf) and carried.fits(mesh):
        missing = embed_pictures(carried.document.copy(), carried.folder)
        if _has_old_tangents(carried, mesh):
            lost.append("tangents, because the texture coordinates changed")
        lost += [f"the image {name}, which is not an image file in the folder of {mesh.source}" for name in missing]
        return lost
    if not isinstance(carried, CarriedGltf) and not _is_single(mesh):
        lost.append("digits beyond single precision")
    if carried is not None:
        lost += carried.further()
    with np.errstate(over="ignore"):
        apart = len(np.unique(mesh.V.astype(np.float32), axis=0))
    if apart < len(mesh.V):
        same = count_of("vertex", "vertices", len(mesh.V) - apart)
        lost.append(f"{same} at positions that coincide with others in single precision")
    words = {line.split(None, 1)[0] for line in mesh.statements.splitlines() if line.split()}
    other_extra = mesh.extra is not None and colours_of(mesh) is None
    faults = {
        "polygons, which are written as triangles": mesh.polygons is not None,
        "data after the coordinates of some vertices, unless they are colours": other_extra,
        "normals, because some faces have none": mesh.FN is not None and normals_of(mesh) is None,
        "groups": words & {b"o", b"g", b"s"},
        "the appearance of materials": b"mtllib" in words and mesh.texture is None,
    }
    return lost + [what for what, holds in faults.items() if holds]


def _is_single(mesh: MeshData) -> bool:
    """Whether the file stores positions, normals and texture coordinates exactly."""
    with np.errstate(over="ignore"):
        pairs = [(table, table.astype(np.float32)) for table in (mesh.V, normals_of(mesh)) if table is not None]
        for uv in (*mesh.lower_maps, mesh.corner_uv):
            places = (uv * [1, -1] + [0, 1]).astype(np.float32)
            pairs.append((uv, places * np.array([1, -1]) + [0, 1]))
    return all(np.array_equal(table, stored, equal_nan=True) for table, stored in pairs)


def _replace_map(carried: CarriedGltf, mesh: MeshData) -> Document:
    """Return the document that was read, with the texture coordinates of a mesh."""
    document = carried.document.copy()
    users, all_places = _users(carried), _convert_places(mesh.corner_uv)
    name = _channel_name(len(mesh.lower_maps))
    for number, pool in enumerate(carried.pools):
        parts, faces = carried.parts_of[number], carried.faces_of(number)
        primitives = [part.entry(document) for part in parts]
        places = all_places[faces]
        if np.isnan(places).all():
            continue
        if np.isnan(places).any():
            raise ValueError("some faces of a primitive have no texture coordinates, which glTF does not support")
        rows, origin, corner = _split(carried.rows[faces] - pool.first, _bits(places), pool.count)
        table = places.reshape(-1, 2)[corner]
        if name in pool.attributes:
            old = document.reals(pool.attributes[name])[origin]
            table = np.where(corner[:, None] < 0, old.astype(np.float32), table)
        if carried.turned or len(origin) > pool.count:
            _extend(document, pool, primitives, origin, users, name, carried.turned)
            bounds = np.cumsum([part.end - part.begin for part in parts])[:-1]
            for primitive, own in zip(primitives, np.split(rows, bounds), strict=True):
                primitive["mode"] = 4
                primitive["indices"] = document.add(_indices(pool.orient(own), len(origin)), indices=True)
        # Channels below that the pool lacks have the same coordinates.
        lacking = [low for low in map(_channel_name, range(len(mesh.lower_maps))) if low not in pool.attributes]
        for one in (*lacking, name):
            _set_numbers(document, [primitive["attributes"] for primitive in primitives], one, table, users)
        if name == PLACES and _has_moved(carried, number, all_places):
            _drop_tangents(primitives)
    return document


def _channel_name(channel: int) -> str:
    """Return the name of the attribute of a channel."""
    return f"TEXCOORD_{channel}"


def _drop_tangents(primitives: list[dict[str, Any]]) -> None:
    """Remove tangents, which depend on the texture coordinates."""
    for primitive in primitives:
        for attributes in (primitive["attributes"], *primitive.get("targets", [])):
            attributes.pop("TANGENT", None)


def _has_old_tangents(carried: CarriedGltf, mesh: MeshData) -> bool:
    """Whether the file has tangents, and the mesh has other texture coordinates."""
    if _channel_name(len(mesh.lower_maps)) != PLACES:
        return False
    places = _convert_places(mesh.corner_uv)
    tangents = [number for number, pool in enumerate(carried.pools) if "TANGENT" in pool.attributes]
    return not np.isnan(places).all() and any(_has_moved(carried, number, places) for number in tangents)


def _has_moved(carried: CarriedGltf, number: int, places: NDArray[np.float32]) -> bool:
    """Whether a pool's triangles have other texture coordinates than ``places`` (f, 3, 2) in the file."""
    pool, faces = carried.pools[number], carried.faces_of(number)
    if PLACES not in pool.attributes:
        return True
    old = carried.document.reals(pool.attributes[PLACES]).astype(np.float32)
    return not np.array_equal(old[carried.rows[faces] - pool.first], places[faces])


def _users(carried: CarriedGltf) -> Counter[int]:
    """Return the number of attributes that refer to each accessor; those of a pool count once."""
    read = {(part.mesh, part.primitive) for part in carried.parts}
    tables = [table for pool in carried.pools for table in (pool.attributes, *pool.targets)]
    for m, mesh in enumerate(carried.document.tree["meshes"]):
        for p, primitive in enumerate(mesh["primitives"]):
            if (m, p) not in read:
                # Any number in such a primitive may be an accessor; one user too many only causes a copy.
                tables += find_objects(primitive, lambda node: True)
    return Counter(accessor for table in tables for accessor in table.values() if isinstance(accessor, int))


def _split(rows: IntArray, keys: IntArray, count: int) -> tuple[IntArray, IntArray, IntArray]:
    """Split vertices whose corners differ, one vertex for each kind of corner; corners of one kind have equal keys.

    Of ``rows`` (k, 3), triangles among ``count`` vertices, and ``keys`` (k, 3, d), return new rows, the old vertex of
    each vertex, and a corner at each vertex as an index into the flattened triangles, -1 for none. The first kind in
    the file keeps the old index; further kinds get indices at the end.
    """
    kinds = np.column_stack([rows.ravel(), keys.reshape(rows.size, -1)])
    unique, first, which = np.unique(kinds, axis=0, return_index=True, return_inverse=True)
    # Sort by vertex, then by first occurrence in the file.
    order = np.lexsort((first, unique[:, 0]))
    vertex = unique[order, 0]
    further = np.diff(vertex, prepend=-1) == 0
    number = vertex.copy()
    number[further] = count + np.arange(np.count_nonzero(further))
    corner = np.full(count + np.count_nonzero(further), -1)
    corner[number] = first[order]
    of_kind = np.empty_like(number)
    of_kind[order] = number
    return of_kind[which.ravel()].reshape(-1, 3), np.concatenate([np.arange(count), vertex[further]]), corner


def _bits(coordinates: NDArray[np.float32]) -> IntArray:
    """Return texture coordinates (..., 2) as integers that are equal where the coordinates are."""
    return (coordinates + np.float32(0)).view(np.int32).astype(np.int64)


def _extend(
    document: Document,
    pool: VertexPool,
    primitives: list[dict[str, Any]],
    origin: IntArray,
    users: Counter[int],
    changed: str,
    turned: bool,
) -> None:
    """Copy the attributes of a pool's vertices, except the changed one, to their copies; reverse normals if turned."""
    attributes = [(name, accessor) for name, accessor in pool.attributes.items() if name != changed]
    shared = [([primitive["attributes"] for primitive in primitives], attributes)]
    for t, target in enumerate(pool.targets):
        shared.append(([primitive["targets"][t] for primitive in primitives], list(target.items())))
    for holders, entries in shared:
        for name, accessor in entries:
            table = document.numbers(accessor)[origin]
            if turned and name == "NORMAL":
                # The least integer has no opposite: subtract 1 from its negative, which is itself.
                table = -table - ((table < 0) & (-table < 0))
            _set_numbers(document, holders, name, table, users, repeated=True)


def _set_numbers(
    document: Document,
    holders: list[dict[str, int]],
    name: str,
    table: NDArray[Any],
    users: Counter[int],
    *,
    repeated: bool = False,
) -> None:
    """Replace the numbers of an attribute that several primitives share; a copy, if something else refers to them."""
    accessor = holders[0].get(name)
    if accessor is None:
        accessor = document.add(table)
    else:
        if users[accessor] > 1:
            old = document.tree["accessors"][accessor]
            document.tree["accessors"].append({key: value for key, value in old.items() if key != "bufferView"})
            accessor = len(document.tree["accessors"]) - 1
            users[accessor] = 1
        document.put(accessor, table, repeated=repeated)
    for holder in holders:
        holder[name] = accessor


def _convert_places(uv: FloatArray) -> NDArray[np.float32]:
    """Return texture coordinates (..., 2) in glTF's convention: v downwards, in single precision."""
    v = 1 - uv[..., 1]
    # Round v so that 1 - v is exact in double precision, and readers lose nothing.
    v = np.where(np.abs(v) < 2.0**-29, np.rint(v / _EXACT) * _EXACT, v)
    return _to_single("a place", np.stack([uv[..., 0], v], axis=-1))


def _to_single(what: str, numbers: FloatArray) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        single = numbers.astype(np.float32)
    if np.isinf(single).any():
        raise ValueError(f"{what} exceeds single precision, the only one in glTF: write .ply or .obj")
    return single


def _indices(rows: IntArray, count: int) -> NDArray[Any]:
    """Return triangles as a column of indices, in 16 bits if possible."""
    return rows.reshape(-1, 1).astype(np.uint16 if count < 1 << 16 else np.uint32)


def _make_document(mesh: MeshData) -> Document:
    """Return a document of one mesh."""
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "quasiharmonic"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": []}],
    }
    document = Document(tree, [])
    maps = [_convert_places(corners) for corners in (*mesh.lower_maps, mesh.corner_uv)]
    places = np.concatenate(maps, axis=2)
    bare = np.asarray(np.isnan(places).any(axis=(1, 2)))
    places[bare] = 0
    normals, colours = normals_of(mesh), colours_of(mesh)
    line = np.zeros_like(mesh.F) if normals is None or mesh.FN is None else mesh.FN
    keys = np.concatenate([_bits(places), line[:, :, None]], axis=2)
    rows, origin, corner = _split(mesh.F, keys, len(mesh.V))
    points = _to_single("a position", mesh.V[origin])
    attributes = {"POSITION": document.add(points)}
    bounds = points.min(axis=0).astype(float).tolist(), points.max(axis=0).astype(float).tolist()
    tree["accessors"][0]["min"], tree["accessors"][0]["max"] = bounds
    if normals is not None:
        attributes["NORMAL"] = document.add(_to_single("a normal", normals[line.ravel()[corner]]))
    if colours is not None:
        attributes["COLOR_0"] = document.add(colours[origin].astype(np.float32))
    placed = {}
    if not bare.all():
        table = places.reshape(-1, places.shape[2])[corner]
        placed = {f"TEXCOORD_{k}": document.add(table[:, 2 * k : 2 * k + 2]) for k in range(len(maps))}
    names: list[str] = []
    for begin, end, name, plain in _runs(mesh, bare):
        primitive: dict[str, Any] = {"attributes": dict(attributes), "mode": 4}
        if not plain:
            primitive["attributes"] |= placed
        primitive["indices"] = document.add(_indices(rows[begin:end], len(origin)), indices=True)
        if name is not None:
            if name not in names:
                names.append(name)
            primitive["material"] = names.index(name)
        tree["meshes"][0]["primitives"].append(primitive)
    tree["materials"] = [{"name": name} for name in names]
    if any("material" not in primitive for primitive in tree["meshes"][0]["primitives"]):
        # Some readers use texture coordinates only with a material.
        tree["materials"].append({})
        for primitive in tree["meshes"][0]["primitives"]:
            primitive.setdefault("material", len(names))
    return document


def _runs(mesh: MeshData, bare: BoolArray) -> Iterator[tuple[int, int, str | None, bool]]:
    """Yield runs of triangles with one material, all with texture coordinates or all without.

    Each run is its first triangle, its end, its material, and whether it has no texture coordinates.
    """
    label, names = label_materials(mesh)
    change = np.flatnonzero((np.diff(label) != 0) | (np.diff(bare) != 0)) + 1
    edges = [0, *change.tolist(), len(mesh.F)]
    for begin, end in pairwise(edges):
        yield begin, end, names[label[begin]], bool(bare[begin])
