"""Surfaces in glTF documents. glTF repeats vertices along seams; vertices at equal positions are merged."""

from __future__ import annotations

import copy
import json
import os
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic.geometry.mesh.splitting import weld_points
from quasiharmonic.io.errors import MeshFileError, report_damage
from quasiharmonic.io.formats.gltf.document import DAMAGE, Document, fault, load, whole
from quasiharmonic.io.models.meshdata import Carried, MeshData, normal_lines
from quasiharmonic.io.untrusted import check_size
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, check_choice, count_of, repeat_each
from quasiharmonic.util.options import INSTANCES

PLACES = "TEXCOORD_0"
# Modes of a glTF primitive.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Volumes with a smaller ratio are equal, up to rounding.
_LARGER = 1 + 1e-9
# A scale of 0 up to rounding, as a fraction of the largest.
_NO_SCALE = 1e-12
_READ = "POSITION", "NORMAL", "COLOR_0", PLACES
# Memory to read a triangle or a vertex, roughly.
_BYTES_TO_READ = 200
_GPU = "EXT_mesh_gpu_instancing"
#: What `CarriedGltf.further` lists if an extension repeats meshes.
GPU_INSTANCES = f"instances of {_GPU}"


@dataclass(frozen=True, eq=False)
class VertexPool:
    """Vertices that one or several primitives of a mesh share."""

    #: Accessors by name.
    attributes: dict[str, int]
    #: Accessors by name, for each morph target.
    targets: list[dict[str, int]]
    mesh: int
    #: Index of the first vertex among those of all pools, and number of vertices.
    first: int
    count: int
    #: Transformation (4, 4) in the scene; None for the identity.
    matrix: FloatArray | None

    @property
    def is_mirrored(self) -> bool:
        """Whether the transformation is a reflection."""
        return self.matrix is not None and float(np.linalg.det(self.matrix[:3, :3])) < 0

    def orient(self, triangles: IntArray) -> IntArray:
        """Return triangles (k, 3) of the file as in the scene, where a reflection reverses them; its own inverse."""
        return triangles[:, [0, 2, 1]] if self.is_mirrored else triangles

    @property
    def rows(self) -> slice:
        """The vertices among those of all pools."""
        return slice(self.first, self.first + self.count)


@dataclass(frozen=True, eq=False)
class Primitive:
    """A primitive: its mesh, its index in the mesh, its pool, and the range of its triangles."""

    mesh: int
    primitive: int
    pool: int
    begin: int
    end: int

    def entry(self, document: Document) -> dict[str, Any]:
        """Return the primitive's entry in a document."""
        found: dict[str, Any] = document.tree["meshes"][self.mesh]["primitives"][self.primitive]
        return found


@dataclass(frozen=True, eq=False)
class CarriedGltf(Carried):
    """A glTF document, the folder of its image files, and the relation of the surface to its primitives.

    ``rows`` (f, 3) has for every corner its vertex among those of all pools. ``turned`` tells whether the triangles are
    those of the document reversed.
    """

    document: Document
    folder: Path
    pools: list[VertexPool]
    parts: list[Primitive]
    rows: IntArray
    turned: bool = False

    def turn_over(self) -> CarriedGltf:
        return replace(self, F=self.F[:, (0, 2, 1)], rows=self.rows[:, (0, 2, 1)], turned=not self.turned)

    @cached_property
    def parts_of(self) -> list[list[Primitive]]:
        """The primitives that use each pool."""
        found: list[list[Primitive]] = [[] for _ in self.pools]
        for part in self.parts:
            found[part.pool].append(part)
        return found

    def faces_of(self, pool: int) -> IntArray:
        """Return the triangles of a pool, in the order of its primitives."""
        return np.concatenate([np.arange(part.begin, part.end) for part in self.parts_of[pool]])

    def number_meshes(self) -> IntArray:
        of_row = repeat_each([pool.mesh for pool in self.pools], [pool.count for pool in self.pools])
        numbers = np.zeros(len(self.V), dtype=np.int64)
        numbers[self.F] = of_row[self.rows]
        return numbers

    def further(self) -> list[str]:
        tree = self.document.tree
        found = [name for name in ("materials", "animations", "skins", "cameras") if tree.get(name)]
        if any(pool.targets for pool in self.pools):
            found.append("morph targets")
        used = [node["mesh"] for node in tree.get("nodes", []) if "mesh" in node]
        if more := len(used) - len(set(used)):
            found.append(f"{count_of('further occurrence', 'further occurrences', more)} of meshes in the scene")
        if _GPU in str(tree.get("extensionsUsed")):
            found.append(GPU_INSTANCES)
        names = sorted({name for pool in self.pools for name in pool.attributes if name not in _READ})
        return found + [f"{name} of vertices" for name in names]


def read_gltf(path: str | os.PathLike[str], *, instances: str = "share") -> MeshData:
    """Read the triangles of a glTF 2.0 file, binary (.glb) or JSON (.gltf).

    A vertex of a glTF file has one texture coordinate, so vertices are repeated along seams. Vertices of one mesh at
    exactly equal positions are merged, and the texture coordinates keep the seams. Positions are those in the scene,
    where a reflection reverses the triangles.

    Parameters
    ----------
    path : str or path-like
        The file. Its buffers are in the file or in its folder; no other file is opened.
    instances : str
        What becomes of a mesh that occurs several times: its first occurrence is used (``"share"``), or every
        occurrence becomes a mesh of its own, also in the file that `write_gltf` writes (``"own"``).

    Returns
    -------
    MeshData
        Triangles in the order of the file, vertices in the order of their first occurrence. Texture coordinates are
        ``TEXCOORD_0`` with v upwards, 1 - v. A merged vertex has the colour of the first vertex at its position.
        Objects and materials become statements. Its ``carried`` has all other data, for `write_gltf`.

    Raises
    ------
    MeshFileError
        If the file is not glTF 2.0, is damaged, is compressed by an extension, or has no triangles.
    """
    check_choice("instances", instances, INSTANCES)
    document = load(path)
    # Overflow is reported later, by the checks for finite numbers.
    with report_damage(path, "is damaged: ", DAMAGE, describe=fault), np.errstate(over="ignore", invalid="ignore"):
        if instances == "own":
            _separate_instances(document.tree)
        mesh = _mesh(document, os.fspath(path))
    if mesh is None:
        raise MeshFileError(path, "has no triangles", remedy="give a mesh with triangles")
    return mesh


def _mesh(document: Document, source: str) -> MeshData | None:
    """Return the surface with all other data of the file; None if there are no triangles."""
    pools, parts, rows, statements = _parts(document)
    if not len(rows):
        return None
    points, kind = _positions(document, pools)
    # Merge equal positions within each mesh.
    V, which = weld_points(np.column_stack([kind, points]))
    F = which[rows]
    vt, known = _attribute(document, pools, PLACES, 2)
    vt[:, 1] = 1 - vt[:, 1]
    normals, shaded = _attribute(document, pools, "NORMAL", 3)
    colours, coloured = _attribute(document, pools, "COLOR_0", None)
    extra = np.full((len(V), colours.shape[1]), np.nan)
    order = np.flatnonzero(coloured)[::-1]
    extra[which[order]] = colours[order]
    mesh = MeshData(
        V[:, 1:],
        F,
        vt=vt if known.any() else None,
        FT=np.where(known[rows], rows, -1) if known.any() else None,
        extra=extra if coloured.any() else None,
        normals=normal_lines(_transform_normals(pools, normals)) if shaded.any() else b"",
        FN=np.where(shaded[rows], rows, -1) if shaded.any() else None,
        statements=b"".join(line for line, _ in statements),
        statement_faces=np.array([face for _, face in statements], dtype=np.int64),
        source=source,
    )
    carried = CarriedGltf(mesh.V, mesh.F, document, Path(source).parent, pools, parts, rows)
    return replace(mesh, carried=carried)


def _parts(document: Document) -> tuple[list[VertexPool], list[Primitive], IntArray, list[tuple[bytes, int]]]:
    """Return pools, parts, the vertices of every triangle among those of all pools, and statements with their faces."""
    tree, pools, parts, known = document.tree, list[VertexPool](), list[Primitive](), dict[str, int]()
    placed = _placements(tree)
    triangles, statements, vertices, faces, named = [np.empty((0, 3), dtype=np.int64)], [], 0, 0, False
    materials, size = list[bytes](), document.size
    for m, mesh in enumerate(tree.get("meshes", [])):
        for p, primitive in enumerate(mesh["primitives"]):
            attributes, targets = primitive["attributes"], primitive.get("targets", [])
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in (_TRIANGLES, _STRIP, _FAN) or "POSITION" not in attributes:
                continue
            # Primitives of one mesh can share vertices; meshes do not, even if they share attributes in the file.
            key = json.dumps([attributes, targets, m], sort_keys=True)
            if key not in known:
                known[key] = len(pools)
                count = _common_count(document, [attributes, *targets])
                pools.append(VertexPool(attributes, targets, m, vertices, count, placed.get(m)))
                vertices += count
            pool = pools[known[key]]
            if "indices" not in primitive:
                corners = np.arange(pool.count)
            else:
                corners = document.numbers(primitive["indices"])[:, 0].astype(np.int64)
            if corners.size and corners.max() >= pool.count:
                raise ValueError(f"mesh {m} refers to vertex {corners.max()}, but there are {pool.count}")
            own = _triangles(corners, mode)
            if (rows := faces + len(own) + vertices) > size:
                check_size(_BYTES_TO_READ * rows, "its meshes repeat the same data, and need")
            parts.append(Primitive(m, p, known[key], faces, faces + len(own)))
            if p == 0 and isinstance(mesh.get("name"), str):
                statements.append((_statement("o", mesh["name"]), faces))
            if "material" in primitive:
                index = whole(primitive["material"])
                # A single material without a name needs no statement.
                if "name" in tree["materials"][index] or len(tree["materials"]) > 1:
                    materials = materials or material_statements(tree)
                    statements.append((materials[index], faces))
                    named = True
            elif named:
                # A statement is valid until the next one.
                statements.append((_statement("usemtl", ""), faces))
                named = False
            triangles.append(pool.first + pool.orient(own))
            faces += len(own)
    return pools, parts, np.concatenate(triangles), statements


def _common_count(document: Document, of: list[dict[str, int]]) -> int:
    """Return the common number of vertices of some attributes; the accessors are read, as their counts may be wrong."""
    count = len(document.numbers(of[0]["POSITION"]))
    for name, accessor in (pair for attributes in of for pair in attributes.items()):
        if len(document.numbers(accessor)) != count:
            raise ValueError(f"{name} and POSITION have different numbers of vertices")
    return count


def _triangles(corners: IntArray, mode: int) -> IntArray:
    """Return the triangles (k, 3) of a list, a strip or a fan."""
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise ValueError(f"a list of triangles has {len(corners)} indices, not a multiple of 3")
        return corners.reshape(-1, 3)
    i = np.arange(max(len(corners) - 2, 0))
    if mode == _FAN:
        return np.stack([corners[i + 1], corners[i + 2], corners[np.zeros_like(i)]], axis=1)
    strip = np.stack([corners[i], corners[i + 1 + i % 2], corners[i + 2 - i % 2]], axis=1)
    # Degenerate triangles only join strips; drop them.
    return strip[(strip != np.roll(strip, 1, axis=1)).all(axis=1)]


def material_statements(tree: dict[str, Any]) -> list[bytes]:
    """Return for each material the statement that names it, by its name or else its index.

    Materials of equal names have their index, too.
    """
    names = [str(one.get("name", k)) for k, one in enumerate(tree.get("materials", []))]
    times = Counter(names)
    return [_statement("usemtl", name if times[name] < 2 else f"{name}.{k}") for k, name in enumerate(names)]


def _statement(keyword: str, name: str) -> bytes:
    # Remove line breaks and backslashes from names, which would damage a line of OBJ.
    return f"{keyword} {' '.join(name.split()) or '-'}".encode("utf-8", "replace").replace(b"\\", b"/") + b"\n"


def _attribute(
    document: Document, pools: list[VertexPool], name: str, width: int | None
) -> tuple[FloatArray, BoolArray]:
    """Return numbers at the vertices of all pools, (v, width), and which vertices have the attribute, (v,) bool."""
    tables = [document.reals(pool.attributes[name]) if name in pool.attributes else None for pool in pools]
    if width is None:
        width = max((table.shape[1] for table in tables if table is not None), default=3)
    total = sum(pool.count for pool in pools)
    numbers, known = np.zeros((total, width)), np.zeros(total, dtype=np.bool_)
    for pool, table in zip(pools, tables, strict=True):
        if table is None:
            continue
        if table.shape[1] > width:
            raise ValueError(f"{name} has {table.shape[1]} numbers for each vertex")
        numbers[pool.rows, : table.shape[1]] = table
        numbers[pool.rows, table.shape[1] :] = 1.0
        known[pool.rows] = True
    return numbers, known


def read_channel(carried: CarriedGltf, channel: int) -> FloatArray | None:
    """Return the texture coordinates (f, 3, 2) of a channel, v upwards, NaN for none; None if no triangle has it."""
    name = f"TEXCOORD_{channel}"
    if not any(name in pool.attributes for pool in carried.pools):
        return None
    return read_corners(carried, name, 2) * [1, -1] + [0, 1]


def read_corners(carried: CarriedGltf, name: str, width: int | None) -> FloatArray:
    """Return an attribute at the corners of all triangles, (f, 3, width) float64; NaN where there is none.

    ``width`` None is the largest number of numbers for a vertex. Raises one of `DAMAGE`.
    """
    table, known = _attribute(carried.document, carried.pools, name, width)
    table[~known] = np.nan
    return table[carried.rows]


def _positions(document: Document, pools: list[VertexPool]) -> tuple[FloatArray, FloatArray]:
    """Return positions (v, 3) in the scene, and the mesh (v,) of each."""
    points, _ = _attribute(document, pools, "POSITION", 3)
    for pool in pools:
        if pool.matrix is not None:
            points[pool.rows] = points[pool.rows] @ pool.matrix[:3, :3].T + pool.matrix[:3, 3]
    return points, repeat_each([pool.mesh for pool in pools], [pool.count for pool in pools]).astype(np.float64)


def _transform_normals(pools: list[VertexPool], normals: FloatArray) -> FloatArray:
    """Return normals (v, 3) in the scene, of unit length if a transformation was applied."""
    for pool in pools:
        if pool.matrix is not None:
            turned = normals[pool.rows] @ _cofactors(pool.matrix).T * (-1 if pool.is_mirrored else 1)
            length = np.linalg.norm(turned, axis=1, keepdims=True)
            normals[pool.rows] = np.divide(turned, length, out=np.zeros_like(turned), where=length > 0)
    return normals


def _cofactors(matrix: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) that transforms areas; it also exists for singular matrices (4, 4)."""
    return np.stack([np.cross(matrix[(i + 1) % 3, :3], matrix[(i + 2) % 3, :3]) for i in range(3)])


def _separate_instances(tree: dict[str, Any]) -> None:
    """Give every node that has the mesh of another node a copy of that mesh."""
    meshes, seen = tree.get("meshes", []), set[int]()
    for node in tree.get("nodes", []):
        if "mesh" in node:
            mesh = whole(node["mesh"])
            if mesh in seen:
                meshes.append(copy.deepcopy(meshes[mesh]))
                node["mesh"] = len(meshes) - 1
            seen.add(mesh)


def _placements(tree: dict[str, Any]) -> dict[int, FloatArray]:
    """Return the transformation (4, 4) of each mesh in the scene, without identities.

    Of several nodes, the one at which the mesh is largest counts, so that its texel density suffices for all. Nodes
    that a scale of 0 collapses, often at the start of an animation, count last.
    """
    nodes = tree.get("nodes", [])
    scenes = tree.get("scenes", [])
    roots = scenes[whole(tree.get("scene", 0))].get("nodes", []) if scenes else []
    waiting = [(whole(root), np.eye(4), False) for root in reversed(roots)]
    placed: dict[int, tuple[float, FloatArray]] = {}
    seen = set()
    while waiting:
        index, above, collapsed = waiting.pop()
        if index in seen:
            continue
        seen.add(index)
        node = nodes[index]
        local, has_zero = _restore_scales(_local_matrix(node, index))
        here, collapsed = above @ local, collapsed or has_zero
        if "mesh" in node:
            # The transformation of a node with a skin is ignored, as glTF specifies.
            matrix, mesh = np.eye(4) if "skin" in node else here, whole(node["mesh"])
            size = 0.0 if collapsed and "skin" not in node else compare_size(matrix)
            if mesh not in placed or size > _LARGER * placed[mesh][0]:
                placed[mesh] = size, matrix
        waiting += [(whole(child), here, collapsed) for child in reversed(node.get("children", []))]
    return {mesh: matrix for mesh, (_, matrix) in placed.items() if not np.array_equal(matrix, np.eye(4))}


def compare_size(matrix: FloatArray) -> float:
    """Return a number to compare occurrences of a mesh by their transformations: the factor on volumes.

    Of two occurrences of equal size, one that is not a reflection has the larger number.
    """
    volume = float(np.linalg.det(matrix[:3, :3]))
    return volume * _LARGER**2 if volume > 0 else -volume


def _restore_scales(matrix: FloatArray) -> tuple[FloatArray, bool]:
    """Return a matrix (4, 4) with its largest scale, or 1, in place of scales of 0; and whether there were any."""
    left, scales, right = np.linalg.svd(matrix[:3, :3])
    zero = scales <= _NO_SCALE * scales[0]
    if not zero.any():
        return matrix, False
    scales[zero] = scales[0] or 1.0
    # Do not mirror the mesh.
    left[:, 2] *= np.sign(np.linalg.det(left @ right))
    restored = matrix.copy()
    restored[:3, :3] = left * scales @ right
    return restored, True


def _local_matrix(node: dict[str, Any], index: int) -> FloatArray:
    """Return the matrix of a node."""
    if "matrix" in node:
        return _numbers(node, "matrix", [0] * 16, index).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = _numbers(node, "rotation", [0, 0, 0, 1], index)
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] = np.array(rotation) * _numbers(node, "scale", [1, 1, 1], index)
    matrix[:3, 3] = _numbers(node, "translation", [0, 0, 0], index)
    return matrix


def _numbers(node: dict[str, Any], name: str, default: list[int], index: int) -> FloatArray:
    """The numbers of a node's entry, as many as its default has; `ValueError` for anything else."""
    values = node.get(name, default)
    is_list = isinstance(values, list)
    if (
        not is_list
        or len(values) != len(default)
        or not all(isinstance(value, int | float) and abs(value) < np.inf for value in values)
    ):
        found = f"{len(values)}" if is_list and len(values) != len(default) else ascii(values)[:40]
        raise ValueError(f"{name} of node {index} must have {len(default)} numbers, not {found}")
    return np.array(values, dtype=np.float64)
