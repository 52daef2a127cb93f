"""Thumbnails of problems and their maps, drawn from the files."""

from __future__ import annotations

from base64 import b64encode
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quasiharmonic import io
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.archives.results import find_map
from quasiharmonic.ui.batch.records import Record
from quasiharmonic.util.arrays import scale_to_unit

if TYPE_CHECKING:
    from quasiharmonic.io import MeshData

# Maximum number of triangles; drawing that many takes about one second.
_MAX_TRIANGLES = 100_000


def thumbnail(record: Record, results: Path | None) -> str:
    """Draw the surface of a record and, if it exists, its map: a ``data:`` address of a PNG, empty if nothing can be
    drawn.
    """
    if (record.get("triangles") or 0) > _MAX_TRIANGLES:
        return ""
    mesh, mapped = _read(record, results)
    if mesh is None or not len(mesh.F) or len(mesh.F) > _MAX_TRIANGLES:
        return ""
    from quasiharmonic.ui.plot import plot_map, plot_surface
    from quasiharmonic.ui.plot.canvas import new_figure, panels, png_bytes

    figure = new_figure((3.2, 1.6) if mapped else (1.6, 1.6))
    axes = panels(figure, 2 if mapped else 1)
    for ax in axes:
        ax.set_position((ax.get_position().x0, 0.03, ax.get_position().width, 0.94))
    V = _center(mesh.V)
    plot_surface(V, mesh.F, axes[0])
    if mapped:
        opened, F, uv = io.without_idle(*io.cut_at_seams(mesh))
        plot_map(_center(opened), F, _center(uv), ax=axes[1])
    return "data:image/png;base64," + b64encode(png_bytes(figure)).decode()


def _read(record: Record, results: Path | None) -> tuple[MeshData | None, bool]:
    """Return the mesh to draw, and whether it has a map."""
    data = None if results is None else find_map(results, record["problem"])
    if data is not None:
        with TemporaryDirectory() as folder:
            path = Path(folder, "map.obj")
            path.write_bytes(data)
            return io.read_mesh(path), True
    candidates = [] if results is None else [(records.map_path(results / record["problem"]), True)]
    if record.get("source"):
        candidates.append((Path(record["source"]), False))
    for path, mapped in candidates:
        try:
            if path.is_file():
                return io.read_mesh(path), mapped
        except (ValueError, OSError):
            continue
    return None, False


def _center(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points translated and scaled by powers of two into a box around the origin, which prevents overflow."""
    points = scale_to_unit(points)
    points = points - points.mean(axis=0)
    return np.ldexp(points, -int(np.frexp(np.abs(points).max() or 1.0)[1]))
