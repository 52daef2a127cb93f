"""``qhm transfer``: transfer values, positions and landmarks from one surface to another.

Transfer positions, values and landmarks from one surface to another. Points that the maps of both surfaces send to
the same position correspond. Both maps must be bijective, which is certified exactly, so the correspondence is one to
one. For maps onto one outline, call qhm map --to with the same outline for both.

Exit status: 0 both maps are certified bijective, and the files are written; 2 wrong input or call, or a map is not
bijective, nothing written; 3 written, but the report failed.

    qhm transfer a_map.obj b_map.obj --values depth.csv depth_on_b.csv
    qhm transfer a_map.obj b_map.obj --landmarks points.txt points_on_b.csv -o b_in_the_shape_of_a.obj
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import pipeline, report
from quasiharmonic.ui.cli.arguments import add_options, choice, file, flag, set_default

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.inverse_map import InverseMap
    from quasiharmonic.apps.surface_map import SurfaceMap
    from quasiharmonic.io import MeshData

_TABLES = ".npy", ".csv", ".txt"


@dataclass(frozen=True, eq=False)
class _MappedFile:
    """A surface with its map, from a file."""

    mesh: MeshData
    inverse: InverseMap  # The surface cut at its seams; the vertices of the file come first
    origin: NDArray[np.int64]  # For each vertex of the cut surface, the vertex of the file; -1 without triangles


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    for name, text in (("source", "surface that the data belong to"), ("target", "surface that receives them")):
        parser.add_argument(
            name, type=Path, metavar=name.upper(), help=f"{text}: {format_names('write_map')} file with a map"
        )
    parser.add_argument(
        "-o",
        "--output",
        **file(
            "file to write: the target, its vertices moved to the corresponding points of the source; "
            f"{format_names('write_map', 'seams')}"
        ),
    )
    pair = {"nargs": 2, "metavar": ("FILE", "OUT"), "action": "append", "default": []}
    add_options(
        parser,
        values=file(
            f"values of the source to transfer to the target's vertices: {', '.join(_TABLES)} (one row per vertex or "
            "triangle), or GIFTI data; may be repeated",
            **pair,
        ),
        nearest=flag(
            "for --values: take the value of the nearest corner instead of interpolating, for labels (default: for the "
            "labels of .label.gii)"
        ),
        per=choice(
            ("vertex", "triangle"), "for --values: whether rows belong to vertices or to triangles (default: vertex)"
        ),
        landmarks=file(
            "file of vertices of the source to transfer, 0-based, one per line, and a .csv file to write: vertex, "
            "triangle of the target, weights of its three corners, nearest corner, position; may be repeated",
            **pair,
        ),
        outside=choice(
            ("nearest", "nan"),
            "for points without a corresponding point: the nearest point of the other map's boundary, or nan "
            "(default: nearest)",
            default="nearest",
        ),
    )
    add_options(parser, "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, certify, transfer, write, report."""
    from dataclasses import replace

    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.surface_map import SurfaceMap
    from quasiharmonic.util.arrays import count_of

    set_default(options, "per", "vertex", asked=bool(options.values), belongs="--values")
    if options.nearest and not options.values:
        raise ValueError("--nearest needs --values: add --values, or omit --nearest")
    outputs = _outputs(options)
    inputs = (options.source, options.target, *(path for path, _ in options.values + options.landmarks))
    report.check_new(outputs, options.json, inputs=inputs)
    source, target = _read(options.source), _read(options.target)
    between = SurfaceMap(target.inverse, source.inverse)
    n = len(target.mesh.V)
    used = target.origin[:n] >= 0
    found = source.inverse.locate(target.inverse.uv[:n])
    outside = int((used & ~found.found).sum())
    written = [str(path) for path in outputs.values()]
    facts: dict[str, Any] = {
        "bijective": True,
        "onto": between.onto,
        "vertices": int(used.sum()),
        "outside": outside,
        "source": {"file": str(options.source), "certificate": source.inverse.certificate.to_dict()},
        "target": {"file": str(options.target), "certificate": target.inverse.certificate.to_dict()},
    }
    # Compute everything before a file is written.
    values = [(out, _values(path, options, source, between)[:n]) for path, out in options.values]
    marks = [(out, _landmarks(path, options, source, target, between)) for path, out in options.landmarks]
    moved = None
    if options.output is not None:
        V = between.transfer(source.inverse.V, outside=options.outside)[:n]
        if np.isnan(V[used]).any():
            raise ValueError(
                f"{count_of('vertex', 'vertices', outside)} of {options.target} have no corresponding point on "
                f"{options.source}, so -o has no positions for them: omit --outside nan, or map both onto the same "
                "outline"
            )
        V[~used] = target.mesh.V[~used]
        with_map = target.mesh.with_places(io.mapped(target.mesh))
        moved = replace(with_map, V=V, normals=b"", FN=None)
        pipeline.tell_losses(options.output, moved)
        io.write_mapped(options.output, moved)
    for out, table in values:
        _write_table(out, table)
    for out, rows in marks:
        io.write_whole(out, rows)

    def describe() -> pipeline.Account:
        instead = "the nearest point of its boundary" if options.outside == "nearest" else "nan"
        lines = [
            f"wrote {', '.join(written)}",
            "Both maps are bijective, verified exactly: "
            f"{count_of('vertex', 'vertices', int(used.sum()) - outside)} of the target "
            "correspond one to one to points of the source.",
        ]
        if outside:
            lines.append(f"{count_of('vertex', 'vertices', outside)} outside the source's map: {instead}")
        return pipeline.Account({**facts, "written": written}, lines)

    return pipeline.finish(options, describe, Path(written[0]))


def _outputs(options: argparse.Namespace) -> dict[str, Path]:
    """Return descriptions of the outputs and their paths; ValueError for a wrong suffix, or without outputs."""
    from quasiharmonic import io

    outputs = {}
    if options.output is not None:
        io.find_format(options.output, "write_map", "seams")
        io.check_output(options.output)
        outputs["-o"] = options.output
    for name, endings in (("values", _TABLES), ("landmarks", (".csv",))):
        for k, (_, out) in enumerate(getattr(options, name), 1):
            if out.suffix.lower() not in endings:
                raise ValueError(f"--{name} … {out}: written as {', '.join(endings)}")
            outputs[f"--{name}" if k == 1 else f"--{name} ({k})"] = out
    if not outputs:
        raise ValueError("nothing to transfer: add --values, --landmarks or -o")
    return outputs


def _read(path: Path) -> _MappedFile:
    """Read a surface with a bijective map; ValueError if the map is not bijective."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.inverse_map import InverseMap

    mesh = io.read_mesh(path)
    V, F, uv = io.cut_at_seams(mesh)
    origin = np.full(len(V), -1, dtype=np.int64)
    origin[F] = mesh.F
    with report.name_source(path):
        inverse = InverseMap(V, F, np.where(origin[:, None] < 0, 0.0, uv))
    return _MappedFile(mesh, inverse, origin)


def _values(path: Path, options: argparse.Namespace, source: _MappedFile, between: SurfaceMap) -> NDArray[np.float64]:
    """Read the values of the source, and return those of the target's vertices; NaN for unused vertices."""
    from quasiharmonic.util.arrays import mark

    values = _read_table(path)
    count = len(source.mesh.V) if options.per == "vertex" else len(source.mesh.F)
    if len(values) != count:
        raise ValueError(
            f"{path} has {len(values)} rows, but {options.source} has {count} "
            f"{'vertices' if options.per == 'vertex' else 'triangles'}"
        )
    if options.per == "vertex":
        values = values[source.origin]
    nearest = options.nearest or values.dtype.kind == "i"
    out = between.transfer(values, per=options.per, outside=options.outside, nearest=nearest)
    out[~mark(len(between.source.V), between.source.F)] = float("nan")
    return out


def _landmarks(
    path: Path, options: argparse.Namespace, source: _MappedFile, target: _MappedFile, between: SurfaceMap
) -> bytes:
    """Return a table of the points of the target that correspond to the landmarks, as CSV."""
    import numpy as np

    from quasiharmonic import io

    marks = io.read_handles(path, len(source.mesh.V))
    if (source.origin[marks] < 0).any():
        raise ValueError(f"{path}: vertex {marks[source.origin[marks] < 0][0]} belongs to no triangle")
    places = source.inverse.uv[marks]
    at = between.source.locate(places)
    if options.outside == "nearest":
        at = between.source.nearest(places, at)
    points = target.inverse.surface(at)
    lines = ["vertex,triangle,weight_0,weight_1,weight_2,nearest_vertex,x,y,z"]
    for mark, triangle, weights, point in zip(
        marks.tolist(), at.triangle.tolist(), at.barycentric.tolist(), points.tolist(), strict=True
    ):
        near = -1 if triangle < 0 else int(target.mesh.F[triangle, int(np.argmax(weights))])
        lines.append(",".join([f"{mark},{triangle}", *map(repr, weights), str(near), *map(repr, point)]))
    return ("\n".join(lines) + "\n").encode()


def _read_table(path: Path) -> NDArray[np.float64] | NDArray[np.int64]:
    """Read rows of numbers, integers only if they are labels; NaN is allowed."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.io.errors import report_damage
    from quasiharmonic.io.untrusted import read_npy
    from quasiharmonic.util.arrays import real_array

    form = io.format_of(path)
    if form is not None and form.name == "GIFTI":
        return io.read_gifti_values(path)
    if path.suffix.lower() not in _TABLES:
        raise ValueError(f"--values {path}: supported: {', '.join(_TABLES)}, .gii")
    with report_damage(path, "not a table of numbers: ", (ValueError, EOFError)):
        if path.suffix.lower() == ".npy":
            return real_array(str(path), read_npy(path))
        lines = [line.partition("#")[0].strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
        rows = [line.replace(",", " ").split() for line in lines if line]
        # A first line without numbers is a heading.
        if rows and not any(_is_number(word) for word in rows[0]):
            rows = rows[1:]
        table = np.array(rows, dtype=np.float64)
    return table[:, 0] if table.ndim == 2 and table.shape[1] == 1 else table


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _write_table(path: Path, values: NDArray[np.float64]) -> None:
    """Write one row per vertex."""
    import numpy as np

    from quasiharmonic import io

    if path.suffix.lower() == ".npy":
        io.write_whole(path, lambda file: np.save(file, values))
        return
    between = "," if path.suffix.lower() == ".csv" else " "
    rows = values.reshape(len(values), -1).tolist()
    io.write_whole(path, "".join(between.join(map(repr, row)) + "\n" for row in rows).encode())
