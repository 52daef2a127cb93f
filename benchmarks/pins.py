"""Solve thousands of problems with pins and a free boundary, feasible by construction; report success and time.

    python benchmarks/pins.py -n 2000 -o pins.jsonl [--families swirl,bend]
    python benchmarks/pins.py --summary pins.jsonl
    python benchmarks/pins.py --case swirl:7

A surface is flattened. A known map of the plane then deforms the flat map as far as it stays bijective, which is
certified exactly. Between 1 and 200 vertices are pinned at their positions in the result, which is stored as
``hidden``. A family and a number name a problem.

Each problem adds one line of JSON when it is done; problems in the file are skipped. The program may be interrupted or
killed at any time and started again. A problem is *solved* if the map is certified bijective and every pin is exactly
at its target position. An exception or a warning counts as a failure. Seconds are CPU seconds of one process, from
arrays to a map of converged distortion; ``placing`` is wall time until the map was bijective.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import traceback
import warnings
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import planar
import problems
from campaign import read
from quasiharmonic import certify, flatten
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.surfaces import cat
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

Record = dict[str, Any]
Generator = np.random.Generator

SMALLEST, LARGEST = 500, 4000
# Maximum number of surfaces drawn to find one that allows a strong enough deformation.
_ATTEMPTS = 200


class Pinned(NamedTuple):
    """A problem.

    Attributes
    ----------
    V, F, fixed, target : arrays
        A surface with a boundary, and the target positions of some of its vertices.
    name : str
    surface : str
        The kind of surface.
    strength : float
        Strength of the deformation; its meaning depends on the family.
    hidden : (n, 2) float64
        A bijective map with these target positions.
    """

    V: FloatArray
    F: IntArray
    fixed: IntArray
    target: FloatArray
    name: str
    surface: str
    strength: float
    hidden: FloatArray


def make(name: str) -> Pinned:
    """Make a problem from a name such as ``swirl:7``.

    Raises
    ------
    ValueError
        If the family does not exist.
    """
    family, _, number = name.partition(":")
    if family not in FAMILIES or not number.isdecimal():
        raise ValueError(f"{name!r} is no name of a problem, such as swirl:7; families are {', '.join(FAMILIES)}")
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([zlib.crc32(family.encode()), int(number), attempt])
        kind, V, F = _make_surface(rng)
        # The flat map has low distortion, is a disk, or is a blend of both.
        flat = flatten(V, F, max_iterations=int(rng.choice([0, 3, 100])), tol=1e-2).uv @ (1, 1j)
        size = planar.span(flat)
        image, strength = FAMILIES[family](rng, (flat - flat.mean()) / size, F)
        # Weak deformations make no useful problem; meshes with slivers allow only those.
        if strength > WEAKEST[family]:
            break
    else:
        raise AssertionError(f"no surface bears {name}")
    # Move, rotate and scale the target.
    image = size * (image * np.exp(2j * np.pi * rng.random() + rng.uniform(-0.7, 0.7)) + rng.normal(0, 2, 2) @ (1, 1j))
    hidden = planar.points(image)
    if not certify(F, hidden).bijective:
        raise AssertionError(f"the solution of {name} is none")
    fixed = _chosen(rng, F, len(V))
    return Pinned(V, F, fixed, hidden[fixed], name, kind, strength, hidden)


def _make_surface(rng: Generator) -> tuple[str, FloatArray, IntArray]:
    """Return the kind, vertices and triangles of a surface with the topology of a plane region."""
    size = int(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    if rng.random() < 0.2:
        return "cat", *cat(max(4, round(np.sqrt(size / 6))))
    holes = int(rng.choice(4, p=(0.55, 0.25, 0.1, 0.1)))
    z, F = planar.blank(rng, size, holes)
    V = problems.dressed(rng, z, F, 0.1 * rng.random())
    return f"made, {len(boundary_loops(F, len(V)))} loops", V, F


def _rings(F: IntArray, n: int, start: int) -> IntArray:
    """Return the distance of each vertex from one vertex, in edges; other components are farthest."""
    distance = np.full(n, n)
    distance[start] = 0
    for ring in range(1, n):
        near = F[(distance[F] == ring - 1).any(axis=1)]
        new = near[distance[near] == n]
        if not new.size:
            break
        distance[new] = ring
    return distance


def _chosen(rng: Generator, F: IntArray, n: int) -> IntArray:
    """Return vertices to pin: anywhere, close together, or on the boundary."""
    count = min(int(np.exp(rng.uniform(0, np.log(200.99)))), n // 3)
    way = rng.choice(["anywhere", "together", "boundary"], p=(0.6, 0.2, 0.2))
    if way == "together":
        order = np.argsort(_rings(F, n, int(rng.integers(n))), kind="stable")
        return np.sort(order[:count])
    pool = np.concatenate(boundary_loops(F, n)) if way == "boundary" else np.arange(n)
    return rng.choice(pool, min(count, len(pool)), replace=False)


def _bijective(z: Callable[[float], ComplexArray], F: IntArray, strength: float) -> tuple[ComplexArray, float]:
    """Return the points moved with the given strength, or with the greatest strength that stays bijective."""
    for _ in range(40):
        image = z(strength)
        if planar.positive(image, F) and certify(F, planar.points(image)).bijective:
            return image, strength
        strength *= 0.85
    return z(0.0), 0.0


def _swirl(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Rotate a disk of the plane, most in its middle."""
    centre, radius = z[rng.integers(len(z))], rng.uniform(0.4, 1.0)
    bump = np.clip(1 - (abs(z - centre) / radius) ** 2, 0, None) ** 2
    return _turned(rng, z, F, centre, bump, rng.uniform(0.5, 6.0))


def _overwound(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Rotate all points, more toward the middle, about as far as the triangles allow."""
    centre = z[np.argsort(abs(z))[rng.integers(1 + len(z) // 10)]]
    return _turned(rng, z, F, centre, 1 - abs(z - centre) / abs(z - centre).max(), 40.0)


def _turned(
    rng: Generator, z: ComplexArray, F: IntArray, centre: complex, share: FloatArray, angle: float
) -> tuple[ComplexArray, float]:
    way = rng.choice([-1, 1])
    return _bijective(lambda t: centre + (z - centre) * np.exp(1j * way * t * share), F, angle)


def _bend(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Bend straight lines into arcs."""
    turn = np.exp(2j * np.pi * rng.random())
    w = z * turn
    return _bijective(
        lambda t: 1j / t * (1 - np.exp(1j * t * w.real) * (1 - t * w.imag)) if t else w, F, rng.uniform(1, 5)
    )


def _pinch(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Contract or expand up to three regions."""
    centres = z[rng.integers(len(z), size=rng.integers(1, 4))]
    radii, signs = rng.uniform(0.2, 0.7, len(centres)), rng.choice([-1, 1], len(centres))

    def moved(t: float) -> ComplexArray:
        w = z
        for centre, radius, sign in zip(centres, radii, signs, strict=True):
            bump = np.clip(1 - (abs(w - centre) / radius) ** 2, 0, None) ** 2
            w = centre + (w - centre) * np.exp(-sign * t * bump)
        return w

    return _bijective(moved, F, rng.uniform(0.5, 3.0))


def _wave(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Shear along waves in two directions."""
    ways = np.exp(2j * np.pi * rng.random(rng.integers(2, 5)))
    numbers, phases = rng.uniform(4, 14, len(ways)), rng.uniform(0, 2 * np.pi, len(ways))

    def moved(t: float) -> ComplexArray:
        w = z
        for way, number, phase in zip(ways, numbers, phases, strict=True):
            w = w + t / number * np.sin(number * (w / way).imag + phase) * way
        return w

    return _bijective(moved, F, rng.uniform(0.5, 2.5))


def _flow(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Apply local twists, drags and pinches in sequence, each by a share of what the triangles allow."""
    strength = rng.uniform(0.2, 0.9)
    for _ in range(rng.integers(2, 7)):
        moved = planar.flow(rng, z, F, 1, strength)
        if certify(F, planar.points(moved)).bijective:
            z = moved
    return z, strength


def _mixed(rng: Generator, z: ComplexArray, F: IntArray) -> tuple[ComplexArray, float]:
    """Apply two to four of these in sequence, each about as strong as bijectivity allows."""
    for name in rng.choice(["swirl", "multiply_wound", "bend", "pinch", "wave", "flow"], rng.integers(2, 5)).tolist():
        z, strength = FAMILIES[name](rng, (z - z.mean()) / planar.span(z), F)
    return z, strength


FAMILIES: dict[str, Callable[[Generator, ComplexArray, IntArray], tuple[ComplexArray, float]]] = {
    "swirl": _swirl,
    "multiply_wound": _overwound,
    "bend": _bend,
    "pinch": _pinch,
    "wave": _wave,
    "flow": _flow,
    "mixed": _mixed,
}
# Minimum strengths of the families' problems.
WEAKEST = {"swirl": 0.5, "multiply_wound": 4.0, "bend": 0.5, "pinch": 0.4, "wave": 0.3, "flow": 0.1, "mixed": 0.0}


def names(count: int, families: Sequence[str]) -> list[str]:
    """Return names of the first problems, families in turn."""
    return [f"{families[i % len(families)]}:{i // len(families)}" for i in range(count)]


def run(name: str) -> Record:
    """Make and solve one problem; catch every exception except those that end the process."""
    record: Record = {"name": name, "family": name.partition(":")[0]}
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            began = time.process_time()
            case = make(name)
            record |= {"surface": case.surface, "triangles": len(case.F), "pins": len(case.fixed)}
            record |= {"strength": round(case.strength, 4), "making": round(time.process_time() - began, 4)}
            began = time.process_time()
            result = flatten(case.V, case.F, fixed=case.fixed, target=case.target)
            record["seconds"] = round(time.process_time() - began, 4)
            certificate = certify(case.F, result.uv)
            met = np.array_equal(result.uv[case.fixed], case.target)
            record |= {
                "outcome": "solved" if certificate.bijective and met else "not solved",
                "status": result.status.name.lower(),
                "placing": round(sum(stage.seconds for stage in result.stages[:-1]), 4),
                "inverted": len(certificate.inverted),
                "summary": certificate.summary(),
                "energy": result.history[-1].energy if result.history else None,
                "diagnosis": result.diagnosis.summary() if result.diagnosis is not None else None,
                "stages": [(s.name, s.n_iterations, *s.inverted, round(s.seconds, 4)) for s in result.stages],
            }
        except Exception as error:
            record |= {"outcome": "exception", "message": repr(error), "trace": traceback.format_exc(limit=-4)}
    if warned and record["outcome"] == "solved":
        record |= {"outcome": "warning", "message": str(warned[0].message)}
    return record


def summary(records: Sequence[Record]) -> str:
    """Return success and time by family, number of pins and kind of surface, and the failures with their commands."""
    lines = [f"{'':24}{'solved':>14}{'seconds: mean':>16}{'50 %':>8}{'95 %':>8}{'most':>8}{'placing: mean':>16}"]
    lines += [_row("all", records), ""]
    for title, key in (("family", _family), ("pins", _pins), ("surface", _surface)):
        groups: dict[str, list[Record]] = defaultdict(list)
        for record in records:
            groups[key(record)].append(record)
        lines += [title, *(_row(f"  {group}", groups[group]) for group in sorted(groups)), ""]
    outcomes = Counter(r["outcome"] for r in records)
    lines.append("outcomes: " + ", ".join(f"{k}: {n}" for k, n in outcomes.most_common()))
    statuses = Counter(r["status"] for r in records if "status" in r)
    lines.append("statuses: " + ", ".join(f"{k}: {n}" for k, n in statuses.most_common()))
    failures = [r for r in records if r["outcome"] != "solved"]
    lines.append(f"{len(failures)} failures among {len(records)} problems")
    lines += [f"  python benchmarks/pins.py --case {r['name']}  # {_story(r)}" for r in failures]
    return "\n".join(lines)


def _family(record: Record) -> str:
    return str(record["family"])


def _pins(record: Record) -> str:
    for low, high in ((1, 1), (2, 3), (4, 10), (11, 30), (31, 100), (101, 200)):
        if low <= record.get("pins", 0) <= high:
            return f"{low:3} to {high:3}"
    return "unknown"


def _surface(record: Record) -> str:
    return str(record.get("surface", "unknown"))


def _row(title: str, records: Sequence[Record]) -> str:
    solved = [r for r in records if r["outcome"] == "solved"]
    share = f"{len(solved)}/{len(records)}"
    if not solved:
        return f"{title:24}{share:>14}"
    seconds = [r["seconds"] for r in solved]
    middle, most = np.percentile(seconds, [50, 95])
    placing = np.mean([r["placing"] for r in solved])
    return (
        f"{title:24}{share:>14}{np.mean(seconds):>16.2f}{middle:>8.2f}{most:>8.2f}{max(seconds):>8.2f}{placing:>16.2f}"
    )


def _story(record: Record) -> str:
    """Describe a failure in a few words."""
    if record["outcome"] != "not solved":
        return f"{record['outcome']}: {record.get('message', '')}"
    where = f"{record['surface']}, {record['triangles']} triangles, {record['pins']} pins"
    return f"{record['status']}, {where}: {record['summary']}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, summarise or repeat; return 1 if any of the problems failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=2000, help="problems (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("pins.jsonl"), help="records (%(default)s)")
    parser.add_argument("--families", default=",".join(FAMILIES), help="separated by commas (all)")
    parser.add_argument("--summary", type=Path, metavar="RESULTS", help="summarise records and end")
    parser.add_argument("--case", action="append", metavar="NAME", help="run just this problem, e.g. swirl:7")
    options = parser.parse_args(arguments)
    families = options.families.split(",")
    unknown = [family for family in families if family not in FAMILIES]
    if unknown:
        parser.error(f"no family {', '.join(unknown)}; there are {', '.join(FAMILIES)}")
    if options.summary and not options.summary.exists():
        parser.error(f"there is no file {options.summary}")

    if options.summary:
        records = read(options.summary)
    elif options.case:
        records = [run(name) for name in options.case]
        print(*(json.dumps(record, indent=1) for record in records), sep="\n")
        return int(any(record["outcome"] != "solved" for record in records))
    else:
        records = _campaign(names(options.count, families), options.output)
    print(summary(records))
    return int(any(record["outcome"] != "solved" for record in records))


def _campaign(todo: Sequence[str], output: Path) -> list[Record]:
    """Solve the problems missing from a file, append them there, and return all of its records."""
    done = {record["name"] for record in read(output)}
    # A line truncated by a kill stays on its own and is not read.
    torn = output.exists() and output.stat().st_size > 0 and output.read_bytes()[-1:] != b"\n"
    try:
        with output.open("a", encoding="utf-8") as file:
            file.write("\n" * torn)
            for name in todo:
                if name in done:
                    continue
                record = run(name)
                file.write(json.dumps(record) + "\n")
                file.flush()
                if record["outcome"] != "solved":
                    print(f"{name}: {_story(record)}", file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
    return read(output)


if __name__ == "__main__":
    sys.exit(main())
