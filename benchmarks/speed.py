"""Time and memory from arrays to the certified map, compared with other tools in the same process.

    pip install '.[bench]'
    python benchmarks/speed.py                                  # generated problems, 1 000 to 130 000 triangles
    python benchmarks/speed.py --triangles 500000 1000000 3500000 --peers igl.harmonic --memory
    python benchmarks/speed.py FOLDER … --triangles             # problem folders only
    python benchmarks/speed.py FOLDER … --triangles --halved 2  # with every edge halved, twice
    python benchmarks/speed.py --animation                      # also 100 frames of a moving boundary
    python benchmarks/speed.py --triangles --join a.csv b.csv   # one table and plot of earlier runs
    python benchmarks/speed.py --fine                           # every iteration on the full mesh
    python benchmarks/speed.py --linear-solver qdldl            # this backend instead of the best available
    OMP_NUM_THREADS=1 python benchmarks/speed.py --processor    # CPU seconds, for busy machines

A generated problem maps a cat's head to the letters C, R and S. A folder is a problem (``input.obj`` +
``handles.txt``) or contains problems at any depth. Tools are interleaved, and the table has medians. If a tool exceeds
``--limit`` seconds, it gets no larger problem. Peak memory is that of a separate process, minus its memory before the
call. Write ``speed.csv``, ``speed.md`` with machine and versions, ``summary.md`` by size, and ``speed.png``.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

import phases
import quasiharmonic
from peers import PEERS
from quasiharmonic import Descent, Problem, boundary_loops, io, is_injective, solve, surfaces
from quasiharmonic.linsolve import available
from quasiharmonic.solver import mapping
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.stages import STRATEGIES
from quasiharmonic.targets import arc_length, letter, rectangle
from quasiharmonic.util.arrays import FloatArray, IntArray

Arrays = tuple[FloatArray, IntArray, IntArray, FloatArray]
Strategy = str | list[Descent]

OURS = "quasiharmonic"
YARDSTICK = "igl.harmonic"
LETTERS = "CRS"
# Limits of the groups of the summary, in triangles.
_SIZES = 0, 2_000, 8_000, 25_000, 50_000, 100_000, 200_000, 400_000, 700_000, 10**9
SIZES = (1_000, 4_000, 16_000, 64_000, 130_000)
FRAMES = 100
_MOVING = f"{FRAMES} frames"
# Phases of an iteration other than factoring and solving.
_REST = "assembly", "gradient", "optimiser"


@dataclass
class Record:
    """The result of one tool on one problem."""

    problem: str
    triangles: int
    tool: str
    seconds: list[float] = field(default_factory=list)
    injective: bool | None = None
    iterations: int | None = None
    phases: list[dict[str, float]] = field(default_factory=list)
    megabytes: float | None = None

    @property
    def median(self) -> float:
        """Median seconds, or NaN if the tool failed."""
        return float(np.median(self.seconds)) if self.seconds else np.nan

    def phase(self, name: str) -> float:
        """Return the median seconds in a phase."""
        return float(np.median([seconds[name] for seconds in self.phases])) if self.phases else np.nan


def cat(triangles: int, character: str) -> Arrays:
    """Return a cat's head with about this many triangles, and a letter as the target of its boundary."""
    halvings = max(0, int(np.ceil(np.log(triangles / 40_000) / np.log(4))))
    V, F = surfaces.cat(max(4, round(np.sqrt(triangles / 6) / 2**halvings)))
    for _ in range(halvings):
        V, F = surfaces.refine(V, F)
    (loop,) = boundary_loops(F, len(V))
    return V, F, loop, arc_length(V[loop], letter(character)[0])


def halved(arrays: Arrays) -> Arrays:
    """Return the problem with every edge halved; new boundary vertices get their edge's target midpoint."""
    V, F, fixed, target = arrays
    places = np.full((len(V), 2), np.nan)
    places[fixed] = target
    V, F = surfaces.refine(V, F)
    places = np.concatenate([places, np.full((len(V) - len(places), 2), np.nan)])
    for loop in boundary_loops(F, len(V)):
        new = np.flatnonzero(np.isnan(places[loop, 0]))
        places[loop[new]] = (places[loop[new - 1]] + places[loop[(new + 1) % len(loop)]]) / 2
    held = np.flatnonzero(~np.isnan(places[:, 0]))
    return V, F, held, places[held]


def problems(sizes: list[int], letters: str, folders: list[Path], times: int = 0) -> Iterator[tuple[str, Arrays]]:
    """Yield names and arrays, smallest first; edges of folders' problems are halved this many times."""
    for size in sizes:
        for character in letters:
            yield f"cat on {character}", cat(size, character)
    for folder in folders:
        for path in sorted(folder.rglob("input.obj")):
            problem = io.read_problem(path.parent)
            arrays: Arrays = problem.V, problem.F, problem.fixed, problem.target
            for _ in range(times):
                arrays = halved(arrays)
            yield path.parent.name, arrays


def measure(
    name: str, arrays: Arrays, tools: list[str], runs: int, strategy: Strategy, linear_solver: str = "auto"
) -> list[Record]:
    """Run the tools on a problem, interleaved."""
    records = [Record(name, len(arrays[1]), tool) for tool in tools]
    for turn in range(runs):
        for record in records:
            if turn and (not record.seconds or record.seconds[0] * turn > 10):
                continue
            clock = phases.Phases()
            try:
                with clock.clocking():
                    began = phases.clock()
                    if record.tool == OURS:
                        result = mapping.injective_map(*arrays, strategy=strategy, linear_solver=linear_solver)
                        uv, record.iterations = result.uv, result.n_iterations
                    else:
                        uv = PEERS[record.tool](*arrays)
                    record.seconds.append(phases.clock() - began)
            except (RuntimeError, ValueError):
                continue
            if record.tool == OURS:
                record.phases.append(clock.seconds)
            record.injective = is_injective(arrays[1], uv)
    return records


def warm_up(tools: list[str]) -> list[str]:
    """Load and compile every tool; return the tools that are available."""
    present = []
    for tool in tools:
        try:
            measure("", cat(100, "C"), [tool], 1, "speed")
            present.append(tool)
        except ImportError as error:
            print(f"without {tool}: {error}; pip install 'quasiharmonic[bench]'", file=sys.stderr)
    return present


def peak_megabytes(arrays: Arrays, tool: str, linear_solver: str = "auto") -> float | None:
    """Return the increase of peak memory by a tool's call, in a fresh process with only the arrays."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "problem.npz")
        np.savez(path, *arrays)
        command = [sys.executable, __file__, "--peak", tool, str(path), "--linear-solver", linear_solver]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    return float(done.stdout) if done.returncode == 0 else None


def print_peak(tool: str, path: Path, linear_solver: str) -> None:
    """Print the result of `peak_megabytes` in the child process."""
    with np.load(path) as stored:
        arrays = tuple(stored[name] for name in stored.files)
    ours = partial(mapping.injective_map, linear_solver=linear_solver)
    run: Callable[..., object] = ours if tool == OURS else PEERS[tool]
    # Solve a small problem first, to load libraries.
    run(*cat(100, "C"))
    before = _peak()
    run(*arrays)
    print(_peak() - before)


def _peak() -> float:
    """Return the peak memory of this process in megabytes."""
    status = Path("/proc/self/status")
    if status.exists():
        # On Linux, resource usage includes the memory of the parent before this process replaced its program.
        lines = status.read_text(encoding="utf-8").splitlines()
        return next(float(line.split()[1]) for line in lines if "VmHWM" in line) / 1024
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)


def animation(triangles: int) -> list[Record]:
    """Bend a strip into a ring, frame by frame: each frame from scratch, and each from the previous map."""
    V, F = surfaces.disk(round(np.sqrt(triangles / 6)))
    (loop,) = boundary_loops(F, len(V))
    strip = arc_length(V[loop], rectangle(8.0, 1.0))

    def bent(angle: float) -> FloatArray:
        radius, turn = 8 / angle, (strip[:, 0] / 8 - 0.5) * angle
        return (radius + 0.5 - strip[:, 1])[:, None] * np.stack([np.sin(turn), -np.cos(turn)], axis=1)

    angles = np.linspace(0.05, 5.8, FRAMES)
    afresh = Record(f"{_MOVING}, each afresh", len(F), OURS, injective=True, iterations=0)
    onwards = Record(f"{_MOVING}, each from the last", len(F), OURS, injective=True, iterations=0)
    problem, last = Problem(V, F, loop, bent(angles[0])), None
    for angle in angles:
        for record in (afresh, onwards):
            began = phases.clock()
            if record is afresh:
                result = mapping.injective_map(V, F, loop, bent(angle))
            else:
                problem = problem.with_target(bent(angle))
                result = solve(problem, start=last)
                last = result.uv
            record.seconds.append(phases.clock() - began)
            record.injective &= result.injective
            record.iterations += result.n_iterations
    for record in (afresh, onwards):
        record.seconds = [sum(record.seconds)]
    return [afresh, onwards]


def machine() -> str:
    """Return CPU, cores, requested threads, versions and the date."""
    model = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    versions = [f"Python {platform.python_version()}", f"quasiharmonic {quasiharmonic.__version__}"]
    for package in ("numpy", "scipy", "mkl", "qdldl", "rslab", "libigl", "mouette"):
        try:
            versions.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    described = f"{model}, {os.cpu_count()} cores, OMP_NUM_THREADS {threads}; {', '.join(versions)}"
    return f"{described}, {time.strftime('%Y-%m-%d')}"


def table(records: list[Record]) -> str:
    """Return a Markdown table of median times by the number of triangles, a column per tool."""
    tools = list(dict.fromkeys(record.tool for record in records))
    rows = []
    for of_size in _by_size(records):
        cells = [_span([triangles for _, triangles in of_size], "{:,}")]
        for tool in tools:
            runs = [r for r in records if r.tool == tool and (r.problem, r.triangles) in of_size]
            done = [r.median for r in runs if r.seconds]
            fails = f" ({len(runs) - len(done)} of {len(runs)} fail)" if len(done) < len(runs) else ""
            cells.append(f"{np.median(done):.3g}{fails}" if done else fails.strip(" ()"))
        rows.append(cells)
    return _markdown(["triangles", *(f"{tool}, s" for tool in tools)], rows)


def size_table(records: list[Record]) -> str:
    """Return a Markdown table of this package's time and memory and their baseline, by the number of triangles."""
    rows = []
    for of_size in _by_size(records):
        times, ratios, memory = [], [], {OURS: [], YARDSTICK: []}
        for key in of_size:
            row = {r.tool: r for r in records if (r.problem, r.triangles) == key}
            if OURS in row and YARDSTICK in row:
                times.append(1e3 * row[OURS].median)
                ratios.append(row[OURS].median / row[YARDSTICK].median)
                for tool, found in memory.items():
                    found += [row[tool].megabytes] if row[tool].megabytes is not None else []
        if ratios:
            cells = [str(len(ratios)), _span([triangles for _, triangles in of_size], "{:,}")]
            cells += [_span([float(f"{x:.2g}") for x in found], "{:g}") for found in (times, ratios)]
            cells += [_span(found, "{:.0f}") for found in memory.values()]
            rows.append(cells)
    heads = ["problems", "triangles", "map, ms", f"ratio to {YARDSTICK}", "peak memory, MB", f"{YARDSTICK}, MB"]
    return _markdown(heads, rows)


def _by_size(records: list[Record]) -> list[list[tuple[str, int]]]:
    """Return the problems in groups of similar size."""
    groups = ([key for key in _rows(records) if low <= key[1] < high] for low, high in itertools.pairwise(_SIZES))
    return [group for group in groups if group]


def _span(values: Sequence[float], shape: str) -> str:
    """Return the least and the greatest value, once if they are equal."""
    return " – ".join(dict.fromkeys(shape.format(value) for value in (min(values), max(values)))) if values else ""


def phase_table(records: list[Record]) -> str:
    """Return a Markdown table of phases in percent of this package's time, and the rest of an iteration."""
    heads = ["problem", "triangles", "iterations", *phases.NAMES, "an iteration's rest / factor + solve"]
    rows = []
    for name, triangles in _rows(records):
        ours = next((r for r in records if (r.problem, r.triangles, r.tool) == (name, triangles, OURS)), None)
        if ours is None:
            continue  # skipped after a smaller problem exceeded the limit
        shares = [f"{100 * ours.phase(phase) / ours.median:.0f}" for phase in phases.NAMES]
        rest, solving = (sum(map(ours.phase, names)) for names in (_REST, ("factor", "solve")))
        rows.append([name, f"{triangles:,}", str(ours.iterations), *shares, f"{rest / solving:.2f}"])
    return _markdown(heads, rows)


def _rows(records: list[Record]) -> list[tuple[str, int]]:
    return list(dict.fromkeys((record.problem, record.triangles) for record in records))


def _markdown(heads: list[str], rows: list[list[str]]) -> str:
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (heads, ["---"] * len(heads), *rows))


def _time(record: Record | None) -> str:
    if record is None:
        return ""
    if not record.seconds:
        return "fails"
    # Mark maps that are not injective; only some other tools claim to avoid inversions.
    return f"{record.median:.4g}{'' if record.injective else ' ×'}"


def write_csv(records: list[Record], path: Path) -> None:
    """Write one line for each tool and problem."""
    with path.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file)
        out.writerow(["problem", "triangles", "tool", "seconds", "injective", "iterations", "megabytes", *phases.NAMES])
        for r in records:
            timed = [f"{r.phase(name):.6f}" if r.phases else "" for name in phases.NAMES]
            facts = [r.problem, r.triangles, r.tool, f"{r.median:.6f}", r.injective, r.iterations, r.megabytes]
            out.writerow(["" if fact is None else fact for fact in facts] + timed)


def read_csv(path: Path) -> list[Record]:
    """Read the output of `write_csv`; seconds are medians."""
    records = []
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            record = Record(row["problem"], int(row["triangles"]), row["tool"])
            record.seconds = [] if row["seconds"] == "nan" else [float(row["seconds"])]
            record.injective = {"True": True, "False": False}.get(row["injective"])
            record.iterations = int(row["iterations"]) if row["iterations"] else None
            record.megabytes = float(row["megabytes"]) if row["megabytes"] else None
            if row[phases.NAMES[0]]:
                record.phases = [{name: float(row[name]) for name in phases.NAMES}]
            records.append(record)
    return records


def draw(records: list[Record], path: Path, unit: str) -> None:
    """Plot seconds over triangles, both logarithmic: for each tool, the medians of the problems of a size."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for tool in dict.fromkeys(record.tool for record in records):
        done = [record for record in records if record.tool == tool and record.seconds]
        groups = [[r for r in done if low <= r.triangles < high] for low, high in itertools.pairwise(_SIZES)]
        points = [
            (np.median([r.triangles for r in group]), np.median([r.median for r in group])) for group in groups if group
        ]
        label = f"{tool}: {'no' if all(record.injective for record in done) else 'some'} inverted triangles"
        axes.loglog(*zip(*points, strict=True), label=label, linewidth=3 if tool == OURS else 1.5)
    axes.set(xlabel="triangles", ylabel=unit)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.grid(which="major", alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _count(text: str) -> int:
    """Parse an argument as a whole number of at least one."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is less than 1")
    return number


def _records(path: str) -> list[Record]:
    """Parse an argument as the records of an earlier run."""
    try:
        return read_csv(Path(path))
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{path} holds no records of this benchmark: {error}") from error


def _folder(path: str) -> Path:
    """Parse an argument as a problem folder."""
    folder = Path(path)
    if next(folder.rglob("input.obj"), None) is None:
        raise argparse.ArgumentTypeError(f"there is no input.obj in {path}, nor in a folder of it")
    return folder


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the table row by row, and write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=_folder, help="problem folders")
    parser.add_argument("--triangles", nargs="*", type=_count, default=list(SIZES), help="sizes of the made problems")
    parser.add_argument("--letters", default=LETTERS, help="their targets (%(default)s)")
    parser.add_argument("--halved", type=int, default=0, metavar="N", help="halve folders' edges so many times")
    parser.add_argument("--peers", nargs="*", choices=list(PEERS), default=list(PEERS), help="what to compare with")
    parser.add_argument("--strategy", choices=STRATEGIES, default="speed", help="%(choices)s (%(default)s)")
    parser.add_argument("--fine", action="store_true", help="VectorAdam alone, on the mesh itself")
    parser.add_argument(
        "--linear-solver", choices=["auto", *available()], default="auto", help="%(choices)s (%(default)s)"
    )
    parser.add_argument("--processor", action="store_true", help="processor's time, on a machine that others use too")
    parser.add_argument("-r", "--runs", type=_count, default=5, help="turns of every tool")
    parser.add_argument("--limit", type=float, default=30, help="seconds, past which a tool gets no larger problem")
    parser.add_argument("--memory", action="store_true", help="peak memory too")
    parser.add_argument("--animation", action="store_true", help="a moving boundary, 20 000 triangles, too")
    parser.add_argument("--join", nargs="*", type=_records, default=[], metavar="CSV", help="records of earlier runs")
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"))
    parser.add_argument("--peak", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.peak:
        return print_peak(options.peak[0], Path(options.peak[1]), options.linear_solver)
    if options.processor:
        phases.clock = time.process_time
    tools = warm_up([OURS, *options.peers])
    strategy: Strategy = [VectorAdam()] if options.fine else options.strategy
    records = [record for joined in options.join for record in joined]
    frames = [record for record in records if record.problem.startswith(_MOVING)]
    records = [record for record in records if record not in frames]
    for name, arrays in problems(options.triangles, options.letters, options.folders, options.halved):
        slow = {
            record.tool for record in records if record.median > options.limit and len(arrays[1]) > record.triangles
        }
        able = [tool for tool in tools if tool not in slow]
        found = measure(name, arrays, able, options.runs, strategy, options.linear_solver)
        for record in found if options.memory else ():
            record.megabytes = peak_megabytes(arrays, record.tool, options.linear_solver)
        records += found
        times = ", ".join(f"{record.tool} {_time(record)}" for record in found) or "every tool has exceeded the limit"
        print(f"{name}, {len(arrays[1])} triangles: {times}", flush=True)
    frames += animation(20_000) if options.animation else []
    text = f"{machine()}{'; CPU seconds' if options.processor else ''}\n"
    if records:
        text += f"\n{table(records)}"
        print(f"\nTime of quasiharmonic by phase, in percent:\n\n{phase_table(records)}")
    for record in frames:
        text += (
            f"\n{record.problem}, {record.triangles} triangles: {record.median:.2f} s, {record.iterations} iterations, "
        )
        text += f"{'all' if record.injective else 'not all'} injective\n"
    print(f"\n{text}")
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "speed.md").write_text(text)
    write_csv(records + frames, options.output / "speed.csv")
    (options.output / "summary.md").write_text(f"{machine()}\n\n{size_table(records)}", encoding="utf-8")
    if records:
        draw(records, options.output / "speed.png", "CPU seconds" if options.processor else "seconds")


if __name__ == "__main__":
    main()
