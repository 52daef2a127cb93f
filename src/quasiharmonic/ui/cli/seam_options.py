"""The surface of a file with the seams that the options request."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.io import MeshData
    from quasiharmonic.io.seamed_mesh import SeamedMesh


@dataclass
class SeamedSurface:
    """Surface of a file with its seams."""

    mesh: SeamedMesh
    facts: dict[str, Any] = field(default_factory=dict)  # Entries for the JSON report
    notes: list[str] = field(default_factory=list)  # Sentences for the text report


def pack_islands(options: argparse.Namespace, mesh: SeamedMesh) -> SeamedMesh:
    """Return the map, packed if requested."""
    from quasiharmonic.apps.atlas import island_functions as atlas

    return atlas.pack(mesh, resolution=options.resolution, padding=options.padding) if options.pack else mesh


def check_packing(options: argparse.Namespace) -> None:
    """Raise ValueError if ``--resolution`` or ``--padding`` is given without ``--pack``."""
    from quasiharmonic.ui.cli import arguments

    arguments.set_default(options, "resolution", arguments.RESOLUTION, asked=options.pack, belongs="--pack")
    arguments.set_default(options, "padding", arguments.PADDING, asked=options.pack, belongs="--pack")


def check_options(options: argparse.Namespace) -> None:
    """Raise ValueError if the file of edges does not exist."""
    if options.seams not in ("file", "none") and not Path(options.seams).is_file():
        raise ValueError(f"--seams {options.seams}: neither 'file' nor 'none', and no file of that name")


def surface(
    options: argparse.Namespace, mesh: MeshData, *, disks_too: bool, joint: NDArray[np.int64] | None = None
) -> SeamedSurface:
    """Return the surface of a file with the seams that the options request.

    If the mesh is welded, ``joint`` (n,) has the representative of each vertex, which the list of edges may name.
    ValueError or OSError as `find_cuts`. Also if only some faces have texture coordinates although there are seams, or
    a line of the list of edges is wrong.
    """
    from quasiharmonic import io
    from quasiharmonic.io.seamed_mesh import SeamedMesh
    from quasiharmonic.ui.cli import report
    from quasiharmonic.util.arrays import count_of

    with report.name_source(mesh.source):
        if options.seams == "file":
            if mesh.FT is not None and getattr(options, "to", "") is not None:
                # A partial map is sufficient only if the map defines the target of the boundary.
                io.check_mapped(mesh)
            found = SeamedSurface(io.seamed(mesh))
        elif options.seams == "none":
            found = SeamedSurface(SeamedMesh(mesh.V, mesh.F))
        else:
            from quasiharmonic.apps.atlas.seam_cuts import cut_along

            edges = read_edges(Path(options.seams), len(mesh.V))
            edges = edges if joint is None else joint[edges]
            found = SeamedSurface(cut_along(SeamedMesh(mesh.V, mesh.F), edges, polygons=mesh.polygons))
        if options.cut:
            # Imported here because the import takes longer than the work for a small mesh.
            from quasiharmonic.apps.atlas.seam_cuts import cut_apart

            before = found.mesh
            found.mesh = cut_apart(
                before, polygons=mesh.polygons, disks_too=disks_too, reach=disks_too or options.refine
            )
            found.facts["cut_edges"] = cut = len(found.mesh.seams) - len(before.seams)
            found.notes.append(
                f"cut along {count_of('edge', 'edges', cut)}: seams of the map; the model's faces are unchanged"
                if cut
                else "nothing to cut: the surface can be flattened without cuts"
            )
    islands = len(found.mesh.islands)
    if islands > 1:
        found.facts["island_count"] = islands
        found.notes.append(
            f"{islands} islands, each mapped on its own"
            + (" (use --seams none to map the surface as one island)" if options.seams != "none" else "")
        )
    return found


def read_edges(path: Path, n: int) -> NDArray[np.int64]:
    """Read edges, two vertex indices below ``n`` per line; (k, 2) int64.

    Blanks, commas or colons separate the indices; ``#`` starts a comment.
    """
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.lowlevel.textual import read_pairs

    rows = []
    for number, ends in read_pairs(path, "an edge"):
        if max(ends) >= n:
            raise MeshFileError(path, f"vertex {max(ends)} of a mesh with {n}", number, "indices count from 0")
        rows.append(ends)
    return np.array(rows, dtype=np.int64).reshape(-1, 2)
