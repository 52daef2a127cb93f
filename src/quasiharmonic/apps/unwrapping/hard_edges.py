"""Hard edges of a model's file: edges with split normals, or between smoothing groups."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np

from quasiharmonic.apps.unwrapping.model_files import label_statements
from quasiharmonic.geometry.mesh.splitting import find_representatives
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.io.models.meshdata import MeshData, normals_of
from quasiharmonic.util.arrays import BoolArray, IntArray

C = TypeVar("C", bound=Callable[..., Any])

# Unit normals that differ by less are equal up to rounding in files.
_SAME = 2e-3


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
