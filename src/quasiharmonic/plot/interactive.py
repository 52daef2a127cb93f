"""A window with a surface, its map, and what the map does to it; drawn by polyscope."""

from __future__ import annotations

import tempfile
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.measures import distortion
from quasiharmonic.plot.canvas import as_mesh, finite

#: Measures of distortion that the window offers as colours.
SHOWN = ("isometric", "conformal", "area_ratio", "mips")


def show(V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, screenshot: str | PathLike[str] | None = None) -> None:
    """Open a window on a surface and its map, and return when it is closed.

    The surface carries a checkerboard that the map puts on it; the map lies beside it. Measures of distortion
    and the inverted triangles can be switched on as colours of both.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float
        The rest surface.
    F : (f, 3) int
    uv : (n, 2) float
        The map.
    screenshot : path, optional
        Write what the window would show as a PNG instead of opening it; no display is needed.

    Raises
    ------
    ImportError
        When polyscope is not installed.
    ValueError
        What `quasiharmonic.distortion` raises.
    RuntimeError
        When no window can be opened.
    """
    polyscope = _polyscope()
    polyscope.set_verbosity(0)
    polyscope.set_use_prefs_file(False)
    polyscope.set_program_name("quasiharmonic")
    polyscope.set_ground_plane_mode("none")
    polyscope.set_allow_headless_backends(screenshot is not None)
    polyscope.init()
    add(V, F, uv)
    try:
        if screenshot is None:
            polyscope.show()
        else:
            _photograph(polyscope, screenshot)
    finally:
        polyscope.remove_all_structures()


def _photograph(polyscope: Any, path: str | PathLike[str]) -> None:
    """Write the view as a PNG, whole or not at all."""
    from quasiharmonic.io.atomic import write_whole

    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "view.png"
        polyscope.screenshot(str(picture), transparent_bg=False)
        write_whole(path, picture.read_bytes())


def add(V: ArrayLike, F: ArrayLike, uv: ArrayLike) -> None:
    """Add a surface and its map to polyscope, which has been initialised, for pictures of one's own.

    Parameters
    ----------
    V, F, uv
        As for `show`. What is added is called "surface" and "map".
    """
    polyscope = _polyscope()
    rest, F = as_mesh(V, F)
    plane = finite(uv, "uv")
    found = distortion(rest, F, plane)
    solid = rest if rest.shape[1] == 3 else np.column_stack([rest, np.zeros(len(rest))])
    middle, size = (solid.min(axis=0) + solid.max(axis=0)) / 2, float(np.ptp(solid, axis=0).max()) or 1.0
    low, extent = plane.min(axis=0), float(np.ptp(plane, axis=0).max()) or 1.0
    unit = (plane - low) / extent
    beside = np.column_stack([(unit - 0.5) * size, np.zeros(len(unit))]) + middle + [1.3 * size, 0, 0]

    inverted = np.zeros(len(F))
    inverted[found.flipped] = 1
    for name, points in (("surface", solid), ("map", beside)):
        drawn = polyscope.register_surface_mesh(name, points, F, edge_width=0.3)
        drawn.add_parameterization_quantity(
            "checkerboard", unit, enabled=True, coords_type="unit", viz_style="checker", checker_size=1 / 24
        )
        for measure in SHOWN:
            values = found.per_triangle()[measure]
            known = np.isfinite(values)
            top = float(np.quantile(values[known], 0.99)) if known.any() else 1.0
            low_end = float(values[known].min()) if known.any() else 0.0
            drawn.add_scalar_quantity(
                measure,
                np.where(known, values, top),
                defined_on="faces",
                vminmax=(low_end, max(top, np.nextafter(low_end, np.inf))),
            )
        drawn.add_scalar_quantity("inverted", inverted, defined_on="faces", cmap="reds", vminmax=(0, 1))


def _polyscope() -> Any:
    try:
        import polyscope
    except ImportError as error:
        raise ImportError("a window needs polyscope: pip install 'quasiharmonic[view]'") from error
    return polyscope
