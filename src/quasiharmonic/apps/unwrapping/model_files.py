"""`unwrap` and the data of a model's file: polygons, hard edges and seams of the file, and the map to write."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any, TypeVar

import numpy as np

from quasiharmonic.apps.unwrapping.result import UnwrapResult
from quasiharmonic.geometry.mesh.reference import area_vectors
from quasiharmonic.geometry.mesh.splitting import find_representatives
from quasiharmonic.geometry.mesh.topology import edge_keys, mark_sides
from quasiharmonic.io.models.appearance import label_materials
from quasiharmonic.io.models.meshdata import MeshData, normals_of
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, find_exponent, first_equal, mark, pad_to_space

C = TypeVar("C", bound=Callable[..., Any])

#: Kinds of parts of a model, by the keywords of the statements of OBJ files that begin them.
PARTS = {"groups": ("o", "g"), "materials": ("usemtl",)}
# Factor on the cost of a seam inside a polygon, which the file cannot store.
_INSIDE_POLYGON = 1e3
# Unit normals that differ by less are equal up to rounding in files.
_SAME = 2e-3


def polygon_costs(mesh: MeshData, costs: FloatArray | None = None) -> FloatArray | None:
    """Return ``edge_costs`` (f, 3) of `unwrap` with large values inside polygons.

    ``costs`` (f, 3) are the costs of the other sides; 1 by default. Without polygons, ``costs`` is returned.
    """
    if mesh.polygons is None:
        return costs
    found = np.ones(mesh.F.shape) if costs is None else costs.copy()
    found[mark_sides(mesh.F, mesh.polygons.diagonals(mesh.F), len(mesh.V))] = _INSIDE_POLYGON
    return found


def corner_positions(mesh: MeshData) -> FloatArray:
    """Return the texture coordinates (f, 3, 2) of every corner; NaN where there are none.

    Raises ValueError if the file has none.
    """
    if mesh.vt is None or mesh.FT is None:
        raise ValueError("the file has no texture coordinates (vt) to keep: omit --keep-seams and --faces")
    return np.where(mesh.FT[:, :, None] >= 0, mesh.vt[mesh.FT], np.nan)


def has_parts(mesh: MeshData, which: str) -> bool:
    """Whether a mesh has parts of a kind in `PARTS`."""
    return any(label_statements(mesh, keyword)[1] for keyword in PARTS[which])


def statement_labels(mesh: MeshData, *keywords: str) -> IntArray:
    """Return a label (f,) for each triangle, equal where the last statements with these keywords in the file are equal.

    The keywords are those of OBJ files: ``o`` and ``g`` for groups, ``usemtl`` for materials.
    """
    columns = [label_statements(mesh, keyword)[0] for keyword in keywords]
    return first_equal(np.stack(columns, axis=1))


def label_statements(mesh: MeshData, keyword: str) -> tuple[IntArray, dict[bytes, int]]:
    """Return the number (f,) of the name in the last statement before each triangle, 0 for none, and these numbers."""
    labels, names = np.zeros(mesh.faces, dtype=np.int64), dict[bytes, int]()
    for line, at in zip(mesh.statements.split(b"\n"), mesh.statement_faces.tolist(), strict=False):
        word, _, name = line.partition(b" ")
        if word == keyword.encode():
            labels[max(at, 0) :] = names.setdefault(name.strip(), len(names) + 1)
    return labels[mesh.rings.of_triangle], names


def material_densities(mesh: MeshData, result: UnwrapResult) -> dict[str, float]:
    """Return the texels per unit of length of each material by its name: the root of texels per area of its surface.

    Materials without area are left out. A file without materials has none.
    """
    label, names = label_materials(mesh)
    measured = ~mark(len(mesh.F), result.cleaned.excluded)
    texels = np.linalg.norm(area_vectors(pad_to_space(result.uvs * result.resolution), result.indices), axis=1)
    # In this unit, squares neither overflow nor underflow.
    exponent = find_exponent(mesh.V)
    area = np.linalg.norm(area_vectors(np.ldexp(mesh.V, -exponent), mesh.F), axis=1)
    sums = [np.bincount(label[measured], values[measured], len(names)) for values in (texels, area)]
    found: dict[str, FloatArray] = {}
    for name, pair in zip(names, np.stack(sums, axis=1), strict=True):
        if name is not None and pair[1] > 0:
            found[name] = found.get(name, 0.0) + pair
    return {name: float(np.ldexp((one / other) ** 0.5, -exponent)) for name, (one, other) in found.items()}


def add_map(mesh: MeshData, result: UnwrapResult) -> tuple[MeshData, int]:
    """Return the mesh with its map, and the number of polygons that are divided into triangles along seams.

    Vertices that were merged share texture coordinates where no seam separates them.
    """
    vt, FT = result.uvs, result.indices
    if (result.cleaned.representatives < np.arange(len(mesh.V))).any():
        chart = np.empty(len(vt))
        chart[FT] = result.charts[:, None]
        first = first_equal(np.column_stack([chart, vt]))
        kept = np.unique(first)
        vt, FT = vt[kept], np.searchsorted(kept, first)[FT]
    return divide_polygons(replace(mesh, vt=vt, FT=FT))


def is_written(written: MeshData, result: UnwrapResult) -> bool:
    """Return whether a file has exactly the certified texture coordinates, triangle by triangle."""
    if written.vt is None or written.FT is None or written.FT.shape != result.indices.shape:
        return False
    return bool(np.array_equal(written.vt[written.FT], result.uvs[result.indices]))


def divide_polygons(mesh: MeshData) -> tuple[MeshData, int]:
    """Divide polygons that seams of the map cross into triangles; return the mesh and the number of these polygons."""
    polygons = mesh.polygons
    if polygons is None or mesh.FT is None:
        return mesh, 0
    # A polygon that is not divided has one row of texture coordinates at each vertex.
    key = (polygons.of_triangle[:, None] * len(mesh.V) + mesh.F).ravel()
    order = np.argsort(key, kind="stable")
    rows, same = mesh.FT.ravel()[order], np.diff(key[order]) == 0
    divided = mark(len(polygons), key[order][1:][same & (np.diff(rows) != 0)] // len(mesh.V))
    if not divided.any():
        return mesh, 0
    before = np.concatenate([[0], np.cumsum(np.where(divided, polygons.sizes - 2, 1))])
    at = np.where(mesh.statement_faces < 0, -1, before[mesh.statement_faces])
    return replace(mesh, polygons=polygons.divide(divided), statement_faces=at), int(divided.sum())


def reads_hard_edges(function: C) -> C:
    """Decorate a function of a mesh so that ``hard_edges="file"`` means the hard edges of the mesh's file."""

    @wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        if isinstance(wanted := options.get("hard_edges"), str) and wanted == "file":
            mesh = args[0] if args else options.get("V")
            if not isinstance(mesh, MeshData):
                raise ValueError('hard_edges="file" needs the path of a file, or a MeshData: pass one, or an angle')
            options = options | {"hard_edges": find_hard_edges(mesh)}
        return function(*args, **options)

    return call  # type: ignore[return-value]


def find_hard_edges(mesh: MeshData) -> IntArray:
    """Return the hard edges (k, 2) of a file, by vertices.

    An edge is hard if the normals of its two triangles differ at one end. Without normals, an edge is hard between two
    smoothing groups, and if smoothing is off; the diagonals of polygons are not.

    Raises
    ------
    ValueError
        If the file has neither normals at all corners nor smoothing groups.
    """
    normals = normals_of(mesh)
    tail, head = mesh.F, mesh.F[:, (1, 2, 0)]
    joint = find_representatives(mesh.V, mesh.F, True)
    tail, head = joint[tail].ravel(), joint[head].ravel()
    key = edge_keys(tail, head, len(joint))
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero((np.diff(key[order]) == 0) & (tail[order] != head[order])[1:])
    one, other = order[first], order[first + 1]
    hard: BoolArray
    if normals is not None and mesh.FN is not None:
        length = np.linalg.norm(normals, axis=1)
        corner = (normals / np.where(length > 0, length, 1.0)[:, None])[mesh.FN]
        start, end = corner.reshape(-1, 3), corner[:, (1, 2, 0)].reshape(-1, 3)
        low, high = (np.where((tail < head)[:, None], *pair) for pair in ((start, end), (end, start)))
        hard = np.maximum(np.abs(low[one] - low[other]), np.abs(high[one] - high[other])).max(axis=1) > _SAME
    else:
        group, names = label_statements(mesh, "s")
        if not names:
            raise ValueError(f"{mesh.source} has neither normals at all corners nor smoothing groups: pass an angle")
        off = np.isin(group, [0, *(names[name] for name in (b"off", b"0") if name in names)])
        polygon = mesh.rings.of_triangle
        a, b = one // 3, other // 3
        hard = ((group[a] != group[b]) | (off[a] & off[b])) & (polygon[a] != polygon[b])
    side = one[hard]
    return np.stack([mesh.F.ravel()[side], mesh.F[:, (1, 2, 0)].ravel()[side]], axis=1)
