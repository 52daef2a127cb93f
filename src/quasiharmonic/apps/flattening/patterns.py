"""The outline of a flat map true to scale, for cutting and sewing, as SVG or DXF.

Both formats are written in millimetres: an SVG drawing has its size on paper, a DXF drawing its unit. Two kinds of
lines are told apart, in SVG by groups and in DXF by layers: the *seam*, which is the boundary of the map, holes
included, and, where there is an allowance, the *cut*, so far outside of it. Around corners the cut is round: it is
where the seam is just so far away.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.topology import components
from quasiharmonic.io.adapters.objects import mesh_triangles
from quasiharmonic.io.atomic import check_writable, write_whole
from quasiharmonic.util.arrays import FloatArray, index_array, map_array, not_negative

#: Millimetres in each unit that a map may be in.
UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
# Sides of the polygon in place of a quarter of a circle: it lacks 0.03 % of the allowance.
_QUARTER = 32
# Around the drawing, and the widths of its lines, in millimetres.
_MARGIN, _WIDTH = 5.0, 0.2


@dataclass(frozen=True, eq=False)
class Pattern:
    """Closed lines in millimetres, first points not repeated.

    Attributes
    ----------
    seam : list of (k, 2) float64
        The boundary of the map, loop by loop, the material to the left.
    cut : list of (k, 2) float64
        The seam with its allowance; the seam itself where there is none.
    """

    seam: list[FloatArray]
    cut: list[FloatArray]


def pattern(F: ArrayLike, uv: ArrayLike, *, unit: str = "mm", allowance: float = 0.0) -> Pattern:
    """The lines along which a flat map is cut and sewn.

    Parameters
    ----------
    F : (f, 3) array of int
        Triangles; pieces that are not connected are pieces of the pattern.
    uv : (n, 2) array
        A bijective map, true to scale.
    unit : {"mm", "cm", "m", "in"}
        Of ``uv`` and of the allowance.
    allowance : float
        How far outside of the seam is cut. Holes become smaller by it, and those that are narrower than twice of it
        vanish.

    Returns
    -------
    Pattern

    Raises
    ------
    ValueError
        When the map is not bijective, the unit is not known, the allowance is negative, or pieces are so near that
        their allowances would overlap.
    ImportError
        When there is an allowance and Shapely is not installed.

    Examples
    --------
    A square of 4 cm with 1 cm around it:

    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> lines = pattern(F, 4 * V, unit="cm", allowance=1)
    >>> [(float(line[0].min()), float(line[0].max())) for line in (lines.seam, lines.cut)]
    [(0.0, 40.0), (-10.0, 50.0)]
    """
    if unit not in UNITS:
        raise ValueError(f"unit must be one of {', '.join(UNITS)}, not {unit!r}")
    not_negative("allowance", allowance)
    triangles, places = index_array("F", mesh_triangles(F)), map_array("uv", uv)
    judged = certify(triangles, places)
    if not judged.bijective:
        raise ValueError(f"the map overlaps itself, so its pattern cannot be cut out. {judged.summary()}")
    with np.errstate(over="ignore"):
        seam = [places[loop] * UNITS[unit] for loop in judged.loops]
    if not all(np.isfinite(line).all() for line in seam):
        raise ValueError(f"the map's coordinates in mm are outside the range of doubles: check the unit {unit}")
    if not allowance:
        return Pattern(seam, seam)
    label = components(triangles, len(places))
    of_piece: dict[int, list[FloatArray]] = {}
    for loop, line in zip(judged.loops, seam, strict=True):
        of_piece.setdefault(int(label[loop[0]]), []).append(line)
    return Pattern(seam, _widened(list(of_piece.values()), allowance * UNITS[unit]))


def write_pattern(
    path: str | os.PathLike[str], F: ArrayLike, uv: ArrayLike, *, unit: str = "mm", allowance: float = 0.0
) -> None:
    """Write the outline of a flat map as a drawing true to scale, whole or not at all.

    Parameters
    ----------
    path : str or path-like
        Ends in ``.svg`` or ``.dxf``.
    F, uv, unit, allowance
        As `pattern` has them.

    Raises
    ------
    ValueError
        When the name has another ending, or as `pattern` does.
    ImportError
        When a package that is needed is not installed: ezdxf for DXF, Shapely for an allowance.
    quasiharmonic.io.OutputError
        When the file cannot be written.
    """
    check_pattern(path, unit=unit, allowance=allowance)
    lines = pattern(F, uv, unit=unit, allowance=allowance)
    write_whole(path, _dxf(lines) if _ending(path) == ".dxf" else _svg(lines))


def check_pattern(path: str | os.PathLike[str], *, unit: str = "mm", allowance: float = 0.0) -> None:
    """Say before there is a map whether its pattern could be written; raises what `write_pattern` would."""
    ending = _ending(path)
    if ending not in (".svg", ".dxf"):
        raise ValueError(f"a pattern must be .svg or .dxf, not {ending or 'without a suffix'}: {path}")
    if unit not in UNITS:
        raise ValueError(f"unit must be one of {', '.join(UNITS)}, not {unit!r}")
    not_negative("allowance", allowance)
    check_writable(path)
    if ending == ".dxf":
        _ezdxf()
    if allowance:
        _shapely()


def _ending(path: str | os.PathLike[str]) -> str:
    return os.path.splitext(os.fspath(path))[1].lower()


def _widened(pieces: list[list[FloatArray]], allowance: float) -> list[FloatArray]:
    """The outlines of pieces, each of its loops, with so much around them."""
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
    """Lines by the name of their kind; without an allowance seam and cut are one."""
    return [("cut", lines.cut)] if lines.cut is lines.seam else [("cut", lines.cut), ("seam", lines.seam)]


def _svg(lines: Pattern) -> bytes:
    """A drawing with the size on paper; y points down there."""
    everything = np.concatenate(lines.cut + lines.seam)
    low, high = everything.min(axis=0) - _MARGIN, everything.max(axis=0) + _MARGIN
    width, height = (high - low).tolist()
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width!r}mm" height="{height!r}mm" '
        f'viewBox="0 0 {width!r} {height!r}" fill="none" stroke="black" stroke-width="{_WIDTH}">'
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
    """A drawing in millimetres, closed polylines on layers CUT and SEAM."""
    ezdxf = _ezdxf()
    stream = io.StringIO()
    # Neither the time nor a random number goes into the file: of the same pattern it is the same.
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
    try:
        import ezdxf
        import ezdxf.units
    except ImportError as error:
        raise ImportError("DXF output needs ezdxf: pip install 'quasiharmonic[patterns]'") from error
    return ezdxf


def _shapely() -> Any:
    try:
        import shapely
    except ImportError as error:
        raise ImportError("an allowance needs Shapely: pip install 'quasiharmonic[shapes]'") from error
    return shapely
