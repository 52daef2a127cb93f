"""Slowest cases: hundreds of scanned surfaces mapped to outlines, and the time of the slowest ones.

    python benchmarks/slowest_cases.py --scans FOLDER [-n 700] [-o tail.jsonl]
    python benchmarks/slowest_cases.py --summary tail.jsonl [OTHER.jsonl …]
    python benchmarks/slowest_cases.py --scans FOLDER --case 17
    python benchmarks/slowest_cases.py --family spirals [-n 20] [-o spirals.jsonl] [--case 17]
    python benchmarks/slowest_cases.py --family pins [-n 20] [-o pins.jsonl] [--case 17]

A number and the folder's files determine a pair: a disk of 1,000 to 20,000 triangles around a random point of a scan,
and its boundary on a letter, a polygon, a star, a comb or a whirl. Interior edges between boundary vertices are split,
since they alone can make a map impossible. Two families of larger problems need no scans. *spirals* maps round meshes
of 30,000 triangles to thin wound bands. *pins* has grids of 17,000 triangles with fixed boundary and 84 pinned interior
vertices, which a warp moves. Pairs that the diagnosis proves infeasible do not count. Seconds are CPU seconds of one
process, from arrays to a certified map. For comparable times use one BLAS thread (``OMP_NUM_THREADS=1
MKL_NUM_THREADS=1``). A campaign may be interrupted and resumed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import outlines
import planar
from campaign import read
from pin_problems import patch_of_scan
from quasiharmonic import Status, injective_map
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.geometry.mesh.refinement import split_edges
from quasiharmonic.geometry.mesh.topology import boundary_loops, edges
from quasiharmonic.surfaces import disk, grid
from quasiharmonic.targets import arc_length, filled
from quasiharmonic.util.arrays import FloatArray, IntArray

Generator = np.random.Generator
Record = dict[str, Any]

SMALLEST, LARGEST = 1000, 20000
OUTLINES: dict[str, Callable[[Generator, float], list[FloatArray]]] = {
    "glyph": outlines.glyph,
    "polygon": outlines.polygon,
    "star": outlines.burst,
    "teeth": outlines.teeth,
    "whirl": outlines.whirl,
}
PERCENTILES = 50, 90, 95, 99, 100


class Pair(NamedTuple):
    """A surface and the target positions of its boundary.

    Attributes
    ----------
    V, F, fixed, target : arrays
        As `injective_map` takes them.
    surface, outline : str
        Their names.
    """

    V: FloatArray
    F: IntArray
    fixed: IntArray
    target: FloatArray
    surface: str
    outline: str


def make(number: int, scans: Sequence[Path]) -> Pair:
    """Make a pair; draw again if the scan has no disk at the drawn point, or too few vertices for the outline."""
    rng = np.random.default_rng([7, number])
    while True:
        path = scans[rng.integers(len(scans))]
        size = int(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
        word = list(OUTLINES)[rng.integers(len(OUTLINES))]
        contour = filled(OUTLINES[word](rng, rng.random()))[0]
        found = patch_of_scan(rng, path, size)
        if found is None or len(found[1]) < SMALLEST or len(boundary_loops(found[1], len(found[0]))) > 1:
            continue
        V, F = _without_chords(*found)
        (loop,) = boundary_loops(F, len(V))
        try:
            target = arc_length(V[loop], contour)
        except ValueError:
            continue
        if check_loops([np.arange(len(loop))], target)[1]:
            continue  # too few vertices: the target would cross itself
        return Pair(V, F, loop, target, path.parent.name if path.stem == "input" else path.stem, word)


def spirals(number: int) -> Pair:
    """A round mesh mapped to a thin band that is wound one to four times."""
    rng = np.random.default_rng([11, number])
    V, F = disk(71)
    (loop,) = boundary_loops(F, len(V))
    turns, half = rng.uniform(1, 4), np.pi * rng.uniform(0.1, 0.4)
    angle = 2 * np.pi * np.linspace(0, turns, 40 + int(40 * turns))
    radius, turn = angle + rng.uniform(1.1, 2) * np.pi, np.exp(1j * angle)
    contour = filled([planar.points(np.concatenate([(radius + half) * turn, ((radius - half) * turn)[::-1]]))])[0]
    return Pair(V, F, loop, arc_length(V[loop], contour), "disk", "spiral")


def pins(number: int) -> Pair:
    """A grid with fixed boundary, and pins moved by a warp that keeps every triangle positive."""
    rng = np.random.default_rng([13, number])
    V, F = grid(93, 93)
    z = np.ascontiguousarray(V[:, :2]).view(np.complex128).ravel()
    rim = np.concatenate(boundary_loops(F, len(V)))
    image = planar.flow(rng, z, F, 5, 0.9, rim)
    inside = np.setdiff1d(np.arange(len(V)), rim)
    fixed = np.append(rim, rng.choice(inside, 84, replace=False))
    return Pair(V, F, fixed, planar.points(image)[fixed], "grid", "pins")


FAMILIES: dict[str, Callable[[int], Pair]] = {"spirals": spirals, "pins": pins}


def _without_chords(V: FloatArray, F: IntArray) -> tuple[FloatArray, IntArray]:
    """Split interior edges that join two boundary vertices."""
    found = edges(F, len(V))
    rim = np.zeros(len(V), dtype=bool)
    rim[found.boundary] = True
    refined = split_edges(V, F, found.interior[rim[found.interior].all(axis=1)])
    return refined.V, refined.F


def run(number: int, pose: Callable[[int], Pair]) -> Record:
    """Make and solve a pair."""
    pair = pose(number)
    record: Record = {"name": str(number), "surface": pair.surface, "outline": pair.outline, "triangles": len(pair.F)}
    began = time.process_time()
    result = injective_map(pair.V, pair.F, pair.fixed, pair.target)
    return record | {
        "seconds": round(time.process_time() - began, 4),
        "injective": result.injective,
        "impossible": result.status is Status.IMPOSSIBLE,
        "iterations": result.n_iterations,
        "inverted": len(result.certificate.inverted),
        "stages": [(s.name, s.n_iterations, *s.inverted, round(s.seconds, 4)) for s in result.stages],
    }


def summary(records: Sequence[Record]) -> str:
    """Return the problems solved, percentiles of seconds, and the slowest problems."""
    counted = [r for r in records if not r["impossible"]]
    solved = [r for r in counted if r["injective"]]
    if not solved:
        return "no pair was solved"
    seconds = np.percentile([r["seconds"] for r in solved], PERCENTILES)
    lines = [
        "| pairs | no map exists | solved | " + " | ".join(f"{p} %" for p in PERCENTILES) + " |",
        "|" + "---|" * (3 + len(PERCENTILES)),
        f"| {len(records)} | {len(records) - len(counted)} | {len(solved)} of {len(counted)} | "
        + " | ".join(f"{s:.2f}" for s in seconds)
        + " |",
        "",
    ]
    unsolved = [r for r in counted if not r["injective"]]
    slowest = sorted(solved, key=lambda r: -r["seconds"])[:10]
    return "\n".join(lines + [_story(r) for r in unsolved + slowest])


def _story(record: Record) -> str:
    course = ", ".join(f"{name} {a}→{b} ({k}, {s:.2f} s)" for name, k, a, b, s in record["stages"])
    verdict = "" if record["injective"] else "unsolved, "
    return (
        f"{record['name']}: {verdict}{record['surface']} onto {record['outline']}, {record['triangles']} triangles, "
        f"{record['seconds']:.2f} s: {course}"
    )


def main() -> None:
    """Run, summarise or repeat."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=Path, help="a folder with OBJ files, in folders of it too")
    parser.add_argument("--family", choices=FAMILIES, help="problems that need no scans")
    parser.add_argument("-n", "--count", type=int, default=700, help="pairs (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("tail.jsonl"), help="records (%(default)s)")
    parser.add_argument("--summary", type=Path, nargs="+", metavar="RESULTS", help="summarise records and end")
    parser.add_argument("--case", type=int, action="append", metavar="NUMBER", help="run just this pair")
    options = parser.parse_args()
    if options.summary:
        for path in options.summary:
            print(f"{path}\n\n{summary(read(path))}\n")
        return
    scans = sorted(options.scans.rglob("*.obj")) if options.scans else []
    if not scans and not options.family:
        parser.error("name a folder with OBJ files or a family: --scans FOLDER, --family NAME")
    pose = FAMILIES[options.family] if options.family else partial(make, scans=scans)
    if options.case:
        print(*(_story(run(number, pose)) for number in options.case), sep="\n")
        return
    done = {record["name"] for record in read(options.output)}
    with options.output.open("a", encoding="utf-8") as file:
        for number in range(options.count):
            if str(number) not in done:
                file.write(json.dumps(run(number, pose)) + "\n")
                file.flush()
    print(summary(read(options.output)))


if __name__ == "__main__":
    main()
