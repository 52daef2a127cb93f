"""Show a surface, its map and the distortion in a polyscope window."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.measures import distortion
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.ui.plot.canvas import RED, as_mesh
from quasiharmonic.util.arrays import FloatArray, map_array, pad_to_space
from quasiharmonic.util.hints import explain_missing

#: Measures of distortion that the window offers as colours.
SHOWN = ("isometric", "conformal", "area_ratio", "mips")
_CHECKERS = (0.93, 0.93, 0.90), (0.16, 0.38, 0.75)


@accepts_mesh
def show(V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, screenshot: str | PathLike[str] | None = None) -> None:
    """Open a window on a surface and its map, and return when it is closed.

    The surface is textured with a checkerboard through the map; the map lies beside it. Inverted triangles are red in
    both. Measures of distortion can be switched on as colours of the other triangles. With ``screenshot``, the view is
    written as a PNG, which needs no display. ImportError if polyscope is not installed, RuntimeError if no window can
    be opened, and ValueError as `quasiharmonic.distortion`.
    """
    from quasiharmonic.io.atomic import encode_by, write_whole

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
            picture = encode_by("view.png", lambda path: polyscope.screenshot(path, transparent_bg=False))
            write_whole(screenshot, picture)
    finally:
        polyscope.remove_all_structures()


def add(V: ArrayLike, F: ArrayLike, uv: ArrayLike) -> None:
    """Add a surface and its map to an initialised polyscope, for custom views.

    The structures are named "surface" and "map". Inverted triangles, if there are any, are separate structures named
    "surface: inverted" and "map: inverted".
    """
    polyscope = _polyscope()
    rest, F = as_mesh(V, F)
    plane = map_array("uv", uv, len(rest))
    found = distortion(rest, F, plane)
    solid = pad_to_space(rest)
    middle, size = (solid.min(axis=0) + solid.max(axis=0)) / 2, float(np.ptp(solid, axis=0).max()) or 1.0
    low, extent = plane.min(axis=0), float(np.ptp(plane, axis=0).max()) or 1.0
    unit = (plane - low) / extent
    beside = pad_to_space((unit - 0.5) * size) + middle + [1.3 * size, 0, 0]

    inverted = np.isin(np.arange(len(F)), found.inverted)
    for name, points in (("surface", solid), ("map", beside)):
        if not inverted.all():
            drawn = polyscope.register_surface_mesh(name, points, F[~inverted], edge_width=0.3)
            drawn.add_parameterization_quantity(
                "checkerboard",
                unit,
                enabled=True,
                coords_type="unit",
                viz_style="checker",
                checker_size=1 / 24,
                checker_colors=_CHECKERS,
            )
            for measure in SHOWN:
                _colour_by(drawn, measure, found.per_triangle()[measure][~inverted])
        if inverted.any():
            # In the map, inverted triangles overlap the others, so they are lifted slightly.
            lifted = points if name == "surface" else points + np.array((0, 0, 2e-3 * size))
            polyscope.register_surface_mesh(
                f"{name}: inverted", lifted, F[inverted], color=RED, edge_width=0.3, back_face_policy="identical"
            )
    width, height = polyscope.get_window_size()
    angle = float(np.radians(polyscope.get_view_camera_parameters().get_fov_vertical_deg()))
    polyscope.look_at(*view_of(np.concatenate([solid, beside]), width / height, angle))


def _colour_by(drawn: Any, measure: str, values: FloatArray) -> None:
    """Register a measure as a colour of a mesh."""
    known = np.isfinite(values)
    top = float(np.quantile(values[known], 0.99)) if known.any() else 1.0
    low_end = float(values[known].min()) if known.any() else 0.0
    drawn.add_scalar_quantity(
        measure,
        np.where(known, values, top),
        defined_on="faces",
        vminmax=(low_end, max(top, np.nextafter(low_end, np.inf))),
    )


def view_of(points: FloatArray, aspect: float, angle: float) -> tuple[FloatArray, FloatArray]:
    """Return the camera and the target of a front view that contains all points (n, 3).

    ``aspect`` is the picture's width divided by its height, ``angle`` the vertical field of view in radians.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    half = 1.05 * (high - low) / 2
    middle = (low + high) / 2
    away = max(half[1], half[0] / aspect) / np.tan(angle / 2) + half[2]
    return middle + np.array((0, 0, away)), middle


def _polyscope() -> Any:
    with explain_missing("a window needs polyscope", extra="view"):
        import polyscope
    return polyscope
