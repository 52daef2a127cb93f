"""Write the outline of a flat map to scale, for cutting and sewing, as SVG or DXF.

Both formats use millimetres: an SVG drawing has its size on paper, a DXF drawing its unit. There are two kinds of
lines, which are groups in SVG and layers in DXF. The *seam* is the boundary of the map, holes included. With an
allowance, the *cut* is the curve at this distance outside the seam, so it is round at corners.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import components
from quasiharmonic.io.atomic import check_writable, write_whole
from quasiharmonic.io.errors import check_path
from quasiharmonic.problem.certification import certify
from quasiharmonic.util.arrays import FloatArray, check_choice, check_non_negative, map_array
from quasiharmonic.util.hints import explain_missing

#: Millimetres per unit of the map.
UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
# Sides of the polygon that replaces a quarter circle; its error is 0.03 % of the allowance.
_QUARTER = 32
# Margin around the drawing in millimetres.
_MARGIN = 5.0
# Line width in millimetres.
_LINE_WIDTH = 0.2


@dataclass(frozen=True, eq=False)
class Pattern:
    """Closed lines (k, 2) in millimetres; first points are not repeated.

    See Also
    --------
    apps.flattening.patterns.pattern : Makes it.

    Examples
    --------
    >>> from quasiharmonic.apps.flattening.patterns import pattern
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> lines = pattern(F, V, unit="cm")
    >>> len(lines.seam), lines.seam[0].max(axis=0).tolist()
    (1, [10.0, 10.0])
    """

    seam: list[FloatArray]  # each (k, 2): boundary loops of the map, with the material on the left
    cut: list[FloatArray]  # each (k, 2): the seam with its allowance; the seam itself without allowance


def pattern(F: ArrayLike, uv: ArrayLike, *, unit: str = "mm", allowance: float = 0.0) -> Pattern:
    """Return the lines along which a flat map is cut and sewn.

    Parameters
    ----------
    F : (f, 3) array of int
        Triangles; each connected component is a piece of the pattern.
    uv : (n, 2) array
        A bijective map, to scale.
    unit : {"mm", "cm", "m", "in"}
        Unit of ``uv`` and of the allowance.
    allowance : float
        Distance of the cut outside the seam. It makes holes smaller, and removes holes narrower than twice the
        allowance.

    Returns
    -------
    Pattern

    Raises
    ------
    ValueError
        If the map is not bijective, the unit is unknown, the allowance is negative, or allowances of pieces overlap.
    ImportError
        If there is an allowance and Shapely is not installed.

    See Also
    --------
    write_pattern : Writes the lines as a drawing.
    flatten : Makes the map.

    Examples
    --------
    A square of 4 cm with 1 cm around it:

    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> lines = pattern(F, 4 * V, unit="cm", allowance=1)
    >>> [(float(line[0].min()), float(line[0].max())) for line in (lines.seam, lines.cut)]
    [(0.0, 40.0), (-10.0, 50.0)]
    """
    check_choice("unit", unit, UNITS)
    check_non_negative("allowance", allowance)
    positions = map_array("uv", uv)
    certificate = certify(F, positions)
    if not certificate.bijective:
        raise ValueError(
            f"the map overlaps itself, so its pattern cannot be cut out. {certificate.summary()} Flatten the surface "
            f"again."
        )
    with np.errstate(over="ignore"):
        seam = [positions[loop] * UNITS[unit] for loop in certificate.loops]
    if not all(np.isfinite(line).all() for line in seam):
        raise ValueError(f"the map's coordinates in mm are outside the range of doubles: check the unit {unit}")
    if not allowance:
        return Pattern(seam, seam)
    label = components(certificate.F, len(positions))
    of_piece: dict[int, list[FloatArray]] = {}
    for loop, line in zip(certificate.loops, seam, strict=True):
        of_piece.setdefault(int(label[loop[0]]), []).append(line)
    return Pattern(seam, _widen(list(of_piece.values()), allowance * UNITS[unit]))


def write_pattern(
    path: str | os.PathLike[str], F: ArrayLike, uv: ArrayLike, *, unit: str = "mm", allowance: float = 0.0
) -> None:
    """Write the outline of a flat map as a drawing to scale, in one atomic operation.

    Parameters
    ----------
    path : str or path-like
        Path that ends in ``.svg`` or ``.dxf``.
    F, uv, unit, allowance
        As for `pattern`.

    Raises
    ------
    ValueError
        If the path has another ending, or as `pattern`.
    ImportError
        If a required package is not installed: ezdxf for DXF, Shapely for an allowance.
    quasiharmonic.io.OutputError
        If the file cannot be written.

    See Also
    --------
    apps.flattening.patterns.pattern : Returns the lines.
    flatten : Makes the map.

    Examples
    --------
    >>> from quasiharmonic import write_pattern
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> write_pattern("square.svg", F, 40 * V)
    """
    check_pattern(path, unit=unit, allowance=allowance)
    lines = pattern(F, uv, unit=unit, allowance=allowance)
    write_whole(path, _dxf(lines) if _find_ending(path) == ".dxf" else _svg(lines))


def check_pattern(path: str | os.PathLike[str], *, unit: str = "mm", allowance: float = 0.0) -> None:
    """Check before mapping whether a pattern can be written; raises the errors of `write_pattern` that the map does not
    cause.
    """
    check_path("path", path)
    ending = _find_ending(path)
    if ending not in (".svg", ".dxf"):
        raise ValueError(f"a pattern must be .svg or .dxf, not {ending or 'without a suffix'}: {path}")
    check_choice("unit", unit, UNITS)
    check_non_negative("allowance", allowance)
    check_writable(path)
    if ending == ".dxf":
        _ezdxf()
    if allowance:
        _shapely()


def _find_ending(path: str | os.PathLike[str]) -> str:
    return os.path.splitext(os.fspath(path))[1].lower()


def _widen(pieces: list[list[FloatArray]], allowance: float) -> list[FloatArray]:
    """The outlines of pieces, each given by its loops, with an allowance around them."""
    shapely = _shapely()
    wide = []
    for loops in pieces:
        outer = max(loops, key=lambda loop: np.ptp(loop[:, 0]))
        holes = [loop for loop in loops if loop is not outer]
        wide.append(shapely.Polygon(outer, holes).buffer(allowance, quad_segs=_QUARTER))
    first, second = shapely.STRtree(wide).query(wide, predicate="intersects")
    near = np.flatnonzero(first < second)
    if near.size:
        i, j = (shapely.get_coordinates(wide[int(side[near[0]])].centroid)[0].tolist() for side in (first, second))
        raise ValueError(
            f"the allowances of the pieces around ({i[0]:.6g}, {i[1]:.6g}) and ({j[0]:.6g}, {j[1]:.6g}) mm overlap: "
            "place them farther apart, or write each to a separate file"
        )
    oriented = [shapely.geometry.polygon.orient(piece) for piece in wide]
    rings = [ring for piece in oriented for ring in (piece.exterior, *piece.interiors)]
    return [shapely.get_coordinates(ring)[:-1] for ring in rings]


def _groups(lines: Pattern) -> list[tuple[str, list[FloatArray]]]:
    """Group lines by kind; without an allowance, seam and cut are one group."""
    return [("cut", lines.cut)] if lines.cut is lines.seam else [("cut", lines.cut), ("seam", lines.seam)]


def _svg(lines: Pattern) -> bytes:
    """Return an SVG drawing with its size on paper; its y axis points down."""
    everything = np.concatenate(lines.cut + lines.seam)
    low, high = everything.min(axis=0) - _MARGIN, everything.max(axis=0) + _MARGIN
    width, height = (high - low).tolist()
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width!r}mm" height="{height!r}mm" '
        f'viewBox="0 0 {width!r} {height!r}" fill="none" stroke="black" stroke-width="{_LINE_WIDTH}">'
    ]
    for name, loops in _groups(lines):
        dashes = ' stroke-dasharray="3 2"' if name == "seam" else ""
        parts.append(f'<g id="{name}"{dashes}>')
        for loop in loops:
            x, y = loop[:, 0] - low[0], high[1] - loop[:, 1]
            points = " L".join(f"{a!r} {b!r}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
            parts.append(f'<path d="M{points} Z"/>')
        parts.append("</g>")
    return "\n".join([*parts, "</svg>", ""]).encode()


def _dxf(lines: Pattern) -> bytes:
    """Return a DXF drawing in millimetres, with closed polylines on layers CUT and SEAM."""
    ezdxf = _ezdxf()
    stream = io.StringIO()
    # Write neither the time nor random identifiers, so that the same pattern gives the same file.
    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        drawing = ezdxf.new("R2010", units=ezdxf.units.MM)
        space = drawing.modelspace()
        for name, loops in _groups(lines):
            layer = drawing.layers.add(name.upper(), color=7 if name == "cut" else 5)
            for loop in loops:
                space.add_lwpolyline(loop.tolist(), close=True, dxfattribs={"layer": layer.dxf.name})
        drawing.write(stream)
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before
    return stream.getvalue().encode(drawing.output_encoding)


def _ezdxf() -> Any:
    with explain_missing("DXF output needs ezdxf", extra="patterns"):
        import ezdxf
        import ezdxf.units
    return ezdxf


def _shapely() -> Any:
    with explain_missing("an allowance needs Shapely", extra="shapes"):
        import shapely
    return shapely
