"""Texture coordinates of the models of a data set."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any

from quasiharmonic import io
from quasiharmonic.apps.unwrapping.model_files import add_map, is_written, polygon_costs
from quasiharmonic.apps.unwrapping.unwrap import unwrap
from quasiharmonic.ui.batch import metadata
from quasiharmonic.ui.batch.records import Record, write_map


def unwrap_model(
    mesh: io.MeshData, options: dict[str, Any], path: Path, record: Record, tell: Callable[[dict[str, Any]], None]
) -> None:
    """Unwrap a model with options of `quasiharmonic.unwrap`, write it to ``path``, and record the certified facts."""
    sizes = {"vertices": len(mesh.V), "triangles": len(mesh.F)}
    tell({"facts": record | sizes})
    with metadata.time_phase(record, "map"):
        result = unwrap(mesh.V, mesh.F, edge_costs=polygon_costs(mesh), jobs=record.get("threads"), **options)
    changes = result.cleaned.changes.items()
    stretch = {"stretch": result.stretch.p99, "isometric": result.stretch.worst}
    record |= {
        **sizes,
        **{name: value if isfinite(value) else None for name, value in stretch.items()},
        "charts": result.n_charts,
        "seam_length": result.seam_length,
        "utilisation": result.utilisation,
        "cleaned": ", ".join(f"{name}: {rows.size}" for name, rows in changes if rows.size) or None,
        "status": result.status.name.lower(),
    }
    with metadata.time_phase(record, "write"):
        write_map(path, add_map(mesh, result)[0])
        certified = result.success and is_written(io.read_mesh(path), result)
    record |= metadata.describe_map(path, "bijective", certified, certified, None)
