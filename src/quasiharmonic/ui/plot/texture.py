"""Render a surface textured with a checkerboard or an image through its map.

Also the figure of texture coordinates: the charts, a checkerboard, the stretch, and the texel density.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from io import BytesIO
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.mesh.topology import boundary_edges, components
from quasiharmonic.io.accepts_mesh import accepts_mesh, writer_accepts_mesh
from quasiharmonic.io.errors import check_path, report_damage
from quasiharmonic.io.models.textures import Texture, read_texture
from quasiharmonic.ui.plot.canvas import (
    RED,
    as_mesh,
    caption,
    draw_edges,
    find_not_positive,
    new_figure,
    paint_map,
    paint_surface,
    panels,
    save_picture,
    scale_for_drawing,
    shade,
    verdict,
    view,
)
from quasiharmonic.ui.plot.measures import choose_scale, draw_bar
from quasiharmonic.util.arrays import FloatArray, IntArray, check_integer, enumerate_each, map_array
from quasiharmonic.util.hints import explain_missing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours of the checkerboard.
_LIGHT = np.array((0.93, 0.93, 0.90))
_DARK = np.array((0.16, 0.38, 0.75))
_SIDE = 600  # pixels of a panel
_SAMPLES = 2  # per pixel and direction
_CHUNK = 1 << 16  # samples processed together, so that they fit into the cache
_SQUARES = 32  # of the checkerboard, along the unit square


@accepts_mesh
def plot_texture(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    squares: int = 24,
    texture: str | PathLike[str] | Texture | None = None,
) -> Figure:
    """Draw a surface with a checkerboard that a map puts on it, beside the same board in the plane.

    Squares stay square where the map preserves angles, and have equal sizes where it preserves areas. Inverted
    triangles are red.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
        The rest surface.
    F : (f, 3) int
    uv : (n, 2) float
        The map.
    squares : int
        Number of squares along the longer side of the map's bounding box.
    texture : path or Texture, optional
        A PNG or JPEG image to use instead of the board. It covers the unit square and repeats beyond it.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        If there are no triangles, a vertex is not finite, ``squares`` is less than 1, or ``texture`` is not an image.
    """
    rest, F = as_mesh(V, F)
    uv = scale_for_drawing(map_array("uv", uv, len(rest)))
    if not F.size:
        raise ValueError("the mesh has no triangles")
    check_integer("squares", squares, minimum=1)
    color: Callable[[FloatArray], FloatArray]
    if texture is None:
        low, size = uv.min(axis=0), float(np.ptp(uv, axis=0).max()) or 1.0
        board, color = (uv - low) / size * squares, _checkerboard_color
    else:
        board, color = uv, _make_image_color(texture)
    inverted = find_not_positive(F, uv)
    seen = view(rest, F)
    figure = new_figure((9.6, 4.8))
    surface, plane = panels(figure, 2)
    _show_render(surface, seen.points, seen.depth, F, board, color, inverted, seen.light)
    caption(surface, f"surface: {len(F):,} triangles")
    _show_render(plane, board, np.zeros(len(uv)), F, board, color, inverted, np.full(len(F), 0.6))
    draw_edges(plane, board, boundary_edges(F, len(board)))
    verdict(plane, "map", len(inverted))
    return figure


@writer_accepts_mesh
def save_texture_figure(
    path: str | PathLike[str],
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    squares: int = 24,
    texture: str | PathLike[str] | Texture | None = None,
) -> None:
    """Write the figure of `plot_texture`, 960 × 480 pixels.

    Parameters
    ----------
    path : path
        Ends in .png, .svg or .pdf. The file is replaced only when the picture is complete.
    V, F, uv, squares, texture
        As for `plot_texture`.

    Raises
    ------
    ValueError
        As for `plot_texture`.
    quasiharmonic.io.errors.OutputError
        If the file cannot be written.
    """
    save_picture(path, plot_texture(V, F, uv, squares=squares, texture=texture))


def _show_render(ax: Axes, points: FloatArray, *scene: Any) -> None:
    """Show what `render` returns for points and the rest of its arguments in axes, in the coordinates of the points."""
    low, high = _window(points)
    ax.imshow(render(points, *scene), interpolation="antialiased", extent=(low[0], high[0], low[1], high[1]))
    ax.set_axis_off()


def _window(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two opposite corners of the square that a panel shows."""
    low, high = points.min(axis=0), points.max(axis=0)
    reach = 0.52 * (float((high - low).max()) or 1.0)
    return (low + high) / 2 - reach, (low + high) / 2 + reach


def render(
    points: FloatArray,
    depth: FloatArray,
    F: IntArray,
    board: FloatArray,
    color_at: Callable[[FloatArray], FloatArray],
    inverted: IntArray,
    light: FloatArray,
) -> FloatArray:
    """Return an image (side, side, 4) of projected triangles, the nearest triangle at each pixel.

    ``points`` (n, 2) and ``depth`` (n,) are the projected vertices. ``board`` (n, 2) are their texture coordinates, and
    ``color_at`` returns colours (k, 3) for texture coordinates (k, 2). ``light`` (f,) is the light on the triangles.
    """
    side = _SIDE * _SAMPLES
    low, high = _window(points)
    place = (points - low) / (high - low) * side
    bad = np.isin(np.arange(len(F)), inverted)

    colors = np.zeros((side * side, 3))
    nearest = np.full(side * side, -np.inf)
    depth_of, board_of = depth[F], board[F]
    for triangle, pixel, weights in _samples(place[F], side):
        z = np.einsum("kc,kc->k", weights, depth_of.take(triangle, axis=0))
        # Of repeated indices the last assignment counts, so sort by depth: the nearest is last.
        order = np.argsort(z, kind="stable")
        order = order[z[order] >= nearest[pixel[order]]]
        triangle, pixel, z, weights = (array.take(order, axis=0) for array in (triangle, pixel, z, weights))
        nearest[pixel] = z
        color = color_at(np.einsum("kc,kcd->kd", weights, board_of.take(triangle, axis=0)))
        color[bad[triangle]] = RED
        colors[pixel] = shade(color, light[triangle])
    grid = colors.reshape(_SIDE, _SAMPLES, _SIDE, _SAMPLES, 3)[::-1]
    covered = np.isfinite(nearest).reshape(_SIDE, _SAMPLES, _SIDE, _SAMPLES)[::-1]
    # Adding the few samples of a pixel one by one is much faster than a sum over two axes.
    samples = [(slice(None), i, slice(None), j) for i in range(_SAMPLES) for j in range(_SAMPLES)]
    cover = sum(covered[sample].astype(np.float64) for sample in samples)
    shown = sum(grid[sample] for sample in samples) / np.maximum(cover, 1)[..., None]
    return np.concatenate([shown, cover[..., None] / _SAMPLES**2], axis=2)


def _checkerboard_color(coordinates: FloatArray) -> FloatArray:
    """Return the colours (k, 3) of a checkerboard whose squares have side 1."""
    column, row = np.floor(coordinates).T
    half = (column + row) / 2
    return np.where((np.floor(half) == half)[:, None], _LIGHT, _DARK)


def _make_image_color(texture: str | PathLike[str] | Texture) -> Callable[[FloatArray], FloatArray]:
    """Return a function from texture coordinates (k, 2) to colours (k, 3) of an image that repeats with period 1."""
    with explain_missing("pictures need Pillow", "pillow"):
        from PIL import Image
    from scipy.ndimage import map_coordinates

    if not isinstance(texture, Texture):
        check_path("texture", texture)
    path, image_file = ("", texture) if isinstance(texture, Texture) else (texture, read_texture(texture))
    damage = OSError, ValueError, SyntaxError, Image.DecompressionBombError
    with report_damage(path, "is a damaged image: ", damage), Image.open(BytesIO(image_file.data)) as image:
        # Details finer than the panel's samples would alias.
        image.thumbnail((_SIDE * _SAMPLES, _SIDE * _SAMPLES))
        glass = image.convert("RGBA")
    white = Image.new("RGBA", glass.size, "white")
    # Rows from bottom to top, as v increases.
    pixels = np.asarray(Image.alpha_composite(white, glass).convert("RGB"), dtype=np.float64)[::-1] / 255
    size = np.array(pixels.shape[1::-1])

    def color(coordinates: FloatArray) -> FloatArray:
        column, row = ((coordinates - np.floor(coordinates)) * size - 0.5).T
        layers = np.moveaxis(pixels, 2, 0)
        return np.stack([map_coordinates(one, (row, column), order=1, mode="grid-wrap") for one in layers], axis=1)

    return color


def _samples(corners: FloatArray, side: int) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """Yield, in chunks, triangles (k,), the samples (k,) inside them, and barycentric coordinates (k, 3)."""
    first = np.maximum(np.ceil(corners.min(axis=1) - 0.5), 0).astype(np.int64)
    last = np.minimum(np.floor(corners.max(axis=1) - 0.5), side - 1).astype(np.int64)
    extent = np.maximum(last - first + 1, 0)
    a, b, c = corners.transpose(1, 0, 2)
    doubled_area = _cross(*(b - a).T, *(c - a).T)
    # The rows of each triangle's box, which are split into chunks, and the samples of each row.
    of, row_of = enumerate_each(extent[:, 1])
    row_of += first[of, 1]
    width = extent[of, 0]
    cuts = np.searchsorted(np.cumsum(width), np.arange(_CHUNK, width.sum(), _CHUNK))
    for part in np.split(np.arange(len(of)), np.unique(cuts)):
        place, column = enumerate_each(width[part])
        triangle, row = of[part][place], row_of[part][place]
        column += first[triangle, 0]
        x, y = column + 0.5, row + 0.5
        (ax, ay), (bx, by), (cx, cy) = (
            (corner[:, 0].take(triangle) - x, corner[:, 1].take(triangle) - y) for corner in (a, b, c)
        )
        parts = _cross(bx, by, cx, cy), _cross(cx, cy, ax, ay), _cross(ax, ay, bx, by)
        area = doubled_area[triangle]
        sign = np.sign(area)
        inside = (area != 0) & (parts[0] * sign >= 0) & (parts[1] * sign >= 0) & (parts[2] * sign >= 0)
        weights = np.stack([value[inside] for value in parts], axis=1) / area[inside, None]
        yield triangle[inside], (row * side + column)[inside], weights


def _cross(ax: FloatArray, ay: FloatArray, bx: FloatArray, by: FloatArray) -> FloatArray:
    return np.asarray(ax * by - ay * bx)


@accepts_mesh
def plot_unwrap(V: ArrayLike, F: ArrayLike, uv: ArrayLike) -> Figure:
    """Draw texture coordinates: the charts, and the surface with a checkerboard, the stretch and the texel density.

    Triangles whose orientation differs from that of their chart are red.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
        Positions; vertices on seams occur once for each chart, as in ``V[result.vmapping]`` of an `UnwrapResult`.
    F : (f, 3) int
    uv : (n, 2) float
        Texture coordinates. Each connected component of ``F`` is a chart, and may be mirrored.

    Returns
    -------
    matplotlib Figure
        Four panels. The stretch is the larger of σ₁ and 1/σ₂ after one scaling of all charts. The texel density is
        relative to its mean.

    Raises
    ------
    ValueError
        If there are no triangles, or a coordinate is not finite.
    """
    rest, F = as_mesh(V, F)
    uv = map_array("uv", uv, len(rest))
    seen = view(rest, F)
    part = components(F, len(rest))
    first, chart = np.unique(part, return_inverse=True)
    a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
    area = np.bincount(chart[F[:, 0]], a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], minlength=len(first))
    upright = uv * np.column_stack([np.where(area[chart] < 0, -1.0, 1.0), np.ones(len(uv))])
    found = distortion(rest, F, upright)
    bad = np.flatnonzero(found.sigma2 <= 0)

    figure = new_figure((18.4, 4.8))
    layout, board, stretched, dense = (figure.add_axes((x, 0.02, 0.225, 0.88)) for x in (0.003, 0.233, 0.463, 0.733))
    # Neighbouring numbers have different colours, and none is red.
    from matplotlib import colormaps

    paint_map(layout, F, uv, colormaps["viridis"](chart[F[:, 0]] * 0.618 % 1)[:, :3], bad)
    verdict(layout, f"{len(first)} charts" if len(first) > 1 else "1 chart", len(bad))
    _show_render(board, seen.points, seen.depth, F, uv * _SQUARES, _checkerboard_color, bad, seen.light)
    caption(board, "checkerboard")
    density = np.sqrt(np.where(found.area_ratio > 0, found.area_ratio, np.nan))
    for ax, name, measure, values, left in (
        (stretched, "stretch", "isometric", found.isometric, 0.694),
        (dense, "texel density, relative to the mean", "area_ratio", density, 0.964),
    ):
        scale = choose_scale(measure, values, found.share)
        color = scale.colors(values)
        color[bad] = RED
        paint_surface(ax, seen, F, shade(color, seen.light))
        caption(ax, name)
        draw_bar(figure, scale, (left, 0.14, 0.008, 0.74))
    return figure
