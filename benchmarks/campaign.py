"""Solve thousands of generated problems unattended; report success, time and failures.

    python benchmarks/campaign.py -n 10000 -o results.jsonl [--families maze,pins] [-j 2]
    python benchmarks/campaign.py -n 1000 -o hard.jsonl --adversarial
    python benchmarks/campaign.py -n 1000 -o refined.jsonl --refine [--only-simple]
    python benchmarks/campaign.py --summary results.jsonl [--table docs/choose/refinement.md]
    python benchmarks/campaign.py --compare before.jsonl after.jsonl
    python benchmarks/campaign.py --case maze:7:0.8

A campaign writes one line of JSON per problem when the problem is done, and skips problems that the file contains. It
may be interrupted or killed at any time and started again. Each problem is solved in a worker process, so a crash or a
timeout is recorded as a result.

A *failure* is a problem with a known solution and no certified injective map. An exception, a warning, non-finite
numbers, a crash or a timeout is also a failure. ``--refine`` may split edges. With it, a problem with a simple target
and no certified bijective map also fails, if double precision can represent such a map. ``--only-simple`` skips all
problems without a simple target: they take most of the time, and a bijective map is not guaranteed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import signal
import sys
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np

from problems import ADVERSARIAL, FAMILIES, make, parse
from quasiharmonic import Problem, Status, solve
from quasiharmonic.solver.construction.constructing import is_simple
from quasiharmonic.solver.search.stages import STRATEGIES
from speed import machine

Record = dict[str, Any]

BANDS = 5
_ALL = FAMILIES | ADVERSARIAL
_DEFAULTS = {"strategy": "speed", "max_iterations": 2000, "refine": False}
# Outcomes that are failures even if no solution is known.
_ALWAYS = "exception", "warning", "not finite", "crash", "timeout"


def names(count: int, families: Sequence[str]) -> Iterator[str]:
    """Yield names of the first problems of a campaign: families in turn, difficulties spread evenly."""
    for i in range(count):
        seed, family = divmod(i, len(families))
        # Multiples of the golden ratio fill the unit interval evenly for any count.
        difficulty = round((0.5 + seed * 0.6180339887498949) % 1.0, 3)
        yield f"{families[family]}:{seed}:{difficulty!r}"


def run(
    name: str,
    *,
    strategy: str = "speed",
    max_iterations: int = 2000,
    refine: bool = False,
    only_simple: bool = False,
) -> Record:
    """Make and solve one problem; catch every exception except those that end the process."""
    family, seed, difficulty = parse(name)
    record: Record = {"name": name, "family": family, "difficulty": difficulty}
    record |= {"strategy": strategy, "max_iterations": max_iterations, "refine": refine}
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            began = time.perf_counter()
            case = make(family, seed, difficulty)
            record |= {"feasible": case.feasible, "simple": case.simple}
            record |= {"triangles": len(case.F), "making": round(time.perf_counter() - began, 4)}
            problem = Problem(case.V, case.F, case.fixed, case.target)
            if only_simple and not is_simple(problem):
                return record | {"outcome": "passed over"}
            record |= _solved(problem, strategy, max_iterations, refine)
        except Exception as error:
            record |= {"outcome": "exception", "message": repr(error), "trace": traceback.format_exc(limit=-4)}
    if warned and record["outcome"] in ("injective", "not injective"):
        record |= {"outcome": "warning", "message": str(warned[0].message)}
    return record


def _solved(problem: Problem, strategy: str, max_iterations: int, refine: bool) -> Record:
    began, effort = time.perf_counter(), time.process_time()
    result = solve(problem, strategy=strategy, max_iterations=max_iterations, refine=refine)
    seconds, cpu = time.perf_counter() - began, time.process_time() - effort
    facts = {}
    if refine:
        # These problems have a bijective map on a sufficiently fine mesh, if double precision can represent it.
        facts = {"promised": is_simple(problem), "no_room": result.status is Status.PRECISION_LIMIT}
        facts |= {"added": result.added, "attempt": result.refinement_attempts[-1].name}
    verdict = "injective" if result.injective else "not injective"
    energy = min((step.energy for step in result.history), default=np.nan)
    return {
        "outcome": verdict if np.isfinite(result.uv).all() else "not finite",
        "uv": hashlib.sha256(result.uv.tobytes()).hexdigest()[:16],
        "status": result.status.name.lower(),
        "inverted": len(result.certificate.inverted) + len(result.certificate.degenerate),
        "bijective": result.certificate.bijective,
        "iterations": result.n_iterations,
        "energy": energy if np.isfinite(energy) else None,
        "seconds": round(seconds, 4),
        "cpu": round(cpu, 4),
        "loops": len(problem.domain.loops),
        "pins": len(problem.domain.pins),
        "interior": problem.n - len(problem.fixed),
        "stages": [(s.name, s.n_iterations, *s.inverted, round(s.seconds, 4)) for s in result.stages],
        **facts,
    }


def failed(record: Record) -> bool:
    """Whether a record is a failure."""
    if record.get("promised") and not record["no_room"] and not record["bijective"]:
        return True
    unsolved = bool(record.get("feasible")) and record["outcome"] not in ("injective", "passed over")
    return record["outcome"] in _ALWAYS or unsolved


def _serve(pipe: Connection, options: dict[str, Any]) -> None:
    """Solve the problems received through a pipe; runs in a worker process."""
    # Ctrl-C reaches the whole process group; the parent decides whether to end this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            name = pipe.recv()
        except EOFError:
            return
        pipe.send(run(name, **options))


class Worker:
    """A process that solves problems one by one and is replaced when it crashes or hangs."""

    def __init__(self, limit: float, options: dict[str, Any]) -> None:
        self.limit, self.options = limit, options
        self.start()

    def start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self.options), daemon=True)
        self.process.start()
        theirs.close()
        # A process imports its libraries before its first answer; this time does not count for the problem.
        self.spare = 30.0

    def ask(self, name: str) -> None:
        self.name, self.deadline = name, time.monotonic() + self.limit + self.spare
        self.pipe.send(name)

    def answer(self) -> Record | None:
        """Return the record of the requested problem, or None while it is being solved."""
        try:
            if self.pipe.poll():
                self.spare = 0.0
                return self.pipe.recv()
        except (EOFError, OSError):
            return self._replaced("crash", f"exit code {self.process.exitcode}")
        if time.monotonic() > self.deadline:
            return self._replaced("timeout", f"over {self.limit:g} s")
        return None

    def _replaced(self, outcome: str, message: str) -> Record:
        self.stop()
        self.start()
        family, _, difficulty = parse(self.name)
        record = {"name": self.name, "family": family, "difficulty": difficulty, **self.options}
        return record | {"outcome": outcome, "message": message}

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def campaign(
    todo: Sequence[str], output: Path, *, processes: int = 1, limit: float = 120.0, **options: Any
) -> Iterator[Record]:
    """Solve the problems missing from ``output``, append every record to it and yield it.

    Parameters
    ----------
    todo : sequence of str
        Names of problems.
    output : path
        A file with one record per line; it need not exist.
    processes : int
    limit : float
        Seconds for one problem.
    **options
        Options of `run`.
    """
    options = _DEFAULTS | options
    # Problems solved with other options are not solved again.
    done = {
        record["name"]
        for record in read(output)
        if all(record.get(key, default) == options[key] for key, default in _DEFAULTS.items())
        and (record["outcome"] != "passed over" or options.get("only_simple"))
    }
    left = [name for name in todo if name not in done][::-1]
    workers = [Worker(limit, options) for _ in range(min(processes, len(left)))]
    try:
        # A line truncated by a kill stays on its own and is not read.
        torn = output.exists() and output.stat().st_size > 0 and output.read_bytes()[-1:] != b"\n"
        with output.open("a", encoding="utf-8") as file:
            file.write("\n" * torn)
            idle, busy = workers[:], list[Worker]()
            while left or busy:
                while left and idle:
                    busy.append(idle.pop())
                    busy[-1].ask(left.pop())
                wait([worker.pipe for worker in busy], timeout=1.0)
                for worker in busy[:]:
                    record = worker.answer()
                    if record is not None:
                        busy.remove(worker)
                        idle.append(worker)
                        file.write(json.dumps(record, allow_nan=False) + "\n")
                        file.flush()
                        yield record
    finally:
        for worker in workers:
            worker.stop()


def read(path: Path) -> list[Record]:
    """Return the records of a file, the last one for every name; skip truncated lines."""
    records: dict[str, Record] = {}
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                record = json.loads(line)
                records[record["name"]] = record
            except (json.JSONDecodeError, KeyError, TypeError):
                continue
    return list(records.values())


def summary(records: Sequence[Record]) -> str:
    """Return success by family and difficulty, effort, stages, and the failures with commands to repeat them."""
    passed = sum(record["outcome"] == "passed over" for record in records)
    records = [record for record in records if record["outcome"] != "passed over"]
    edges = [f"{b / BANDS:.1f}–{(b + 1) / BANDS:.1f}" for b in range(BANDS)]
    head = f"{'family':10}" + "".join(f"{edge:>12}" for edge in edges)
    lines = [
        head + f"{'all':>12}{'iterations':>13}{'seconds':>15}",
        " " * len(head) + f"{'':12}{'50 %  95 %':>13}{'50 %  95 %':>15}",
    ]
    groups: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        groups[record["family"]].append(record)
    # Records of crashes and timeouts lack feasibility, but it is the same for a whole family.
    solvable = {r["family"] for r in records if r.get("feasible")}
    feasible = [r for r in records if r["family"] in solvable]
    for family in [f for f in _ALL if f in groups]:
        lines.append(_row(family + ("" if family in solvable else " ?"), groups[family]))
    lines += [
        _row("feasible", feasible),
        _row("  simple", [r for r in feasible if r.get("simple")]),
        "",
        "?: nobody knows which of these have a solution.",
        "",
    ]
    lines += [*_by_stage(feasible), ""]
    if any("attempt" in r for r in records):
        lines += [*_by_attempt([r for r in records if "attempt" in r]), ""]
    last = Counter(r["stages"][-1][0] if r.get("stages") else "-" for r in records if r["outcome"] == "injective")
    lines += ["found by: " + "; ".join(f"{k}: {n}" for k, n in last.most_common())]
    lines += [
        "outcomes: " + ", ".join(f"{k}: {n}" for k, n in Counter(r["outcome"] for r in records).most_common()),
        "",
    ]
    if passed:
        lines += [f"{passed} passed over, whose targets are not simple", ""]
    failures = [r for r in records if failed(r)]
    lines.append(
        f"{len(failures)} failures among {len(records)} problems, {len(feasible)} of them known to be feasible"
    )
    for r in failures:
        changed = "".join(
            f" --{key.replace('_', '-')}" + ("" if r[key] is True else f" {r[key]}")
            for key, default in _DEFAULTS.items()
            if r.get(key, default) != default
        )
        lines.append(f"  python benchmarks/campaign.py --case {r['name']}{changed}  # {_story(r)}")
    return "\n".join(lines)


def _by_stage(records: Sequence[Record]) -> list[str]:
    """Return how many problems were solved up to each stage, by family."""
    solved = [r for r in records if r["outcome"] == "injective"]
    if not solved:
        return []
    most = max(len(r["stages"]) for r in solved)
    names = [Counter(r["stages"][k][0].split(",")[0] for r in solved if len(r["stages"]) > k) for k in range(most)]
    words = [count.most_common(1)[0][0] for count in names]
    lines = ["feasible problems solved up to each stage: the first, and after each fallback"]
    lines.append(f"{'family':10}{'of':>6}" + "".join(f"{word:>16}" for word in words))
    families = [family for family in _ALL if any(r["family"] == family for r in records)]
    for family in [*families, "all"]:
        some = [r for r in records if family in (r["family"], "all")]
        depth = [len(r["stages"]) if r["outcome"] == "injective" else most + 1 for r in some]
        counts = [sum(d <= k + 1 for d in depth) for k in range(most)]
        lines.append(f"{family:10}{len(some):>6}" + "".join(f"{count:>16}" for count in counts))
    return lines


def _row(title: str, records: Sequence[Record]) -> str:
    cells = []
    for band in range(BANDS):
        cells.append([r for r in records if min(int(r["difficulty"] * BANDS), BANDS - 1) == band])
    shares = [f"{sum(r['outcome'] == 'injective' for r in cell)}/{len(cell)}" for cell in [*cells, records]]
    won = [r for r in records if r["outcome"] == "injective"]
    effort = ["-", "-"]
    if won:
        effort = [
            "{:.0f} {:5.0f}".format(*np.percentile([r["iterations"] for r in won], [50, 95])),
            "{:.3f} {:6.3f}".format(*np.percentile([r["seconds"] for r in won], [50, 95])),
        ]
    return f"{title:10}" + "".join(f"{share:>12}" for share in shares) + f"{effort[0]:>13}{effort[1]:>15}"


def _by_attempt(records: Sequence[Record]) -> list[str]:
    """Return problems solved by each refinement attempt, vertices added and time."""
    lines = []
    for title, kind in (("simple targets", True), ("others", False)):
        group = [r for r in records if r["promised"] is kind]
        done = [r for r in group if r["outcome"] == "injective"]
        lines.append(
            f"{title}: {len(done)} of {len(group)} mapped, {sum(r['bijective'] for r in group)} of them bijectively, "
            f"{sum(r['no_room'] for r in group)} without room in doubles"
        )
        for attempt in dict.fromkeys(r["attempt"] for r in done):
            by = [r for r in done if r["attempt"] == attempt]
            added, cpu = [r["added"] for r in by], [r["cpu"] for r in by]
            lines.append(
                f"  {attempt}: {len(by)}; vertices added (50 %, 95 %, most) {_spread(added, 95, 'g')}; "
                f"CPU seconds (50 %, 99 %, most) {_spread(cpu, 99, '.2f')}"
            )
    return lines


def refinement_table(records: Sequence[Record]) -> str:
    """Return a Markdown table of the attempts that mapped the problems with simple targets."""
    group = [r for r in records if r.get("promised")]
    lines = [
        machine(),
        "",
        "| attempt | problems | bijective | vertices added: median, 95 %, most | CPU s: median, 99 %, most |",
        "|---|---|---|---|---|",
    ]
    for attempt in [*dict.fromkeys(r["attempt"] for r in group), "all"]:
        some = [r for r in group if attempt in (r["attempt"], "all")]
        added, cpu = _spread([r["added"] for r in some], 95, "g"), _spread([r["cpu"] for r in some], 99, ".2g")
        lines.append(f"| {attempt} | {len(some)} | {sum(r['bijective'] for r in some)} | {added} | {cpu} |")
    return "\n".join(lines)


def _spread(values: Sequence[float], upper: int, form: str) -> str:
    """Return the median, an upper percentile and the maximum."""
    return ", ".join(f"{value:{form}}" for value in np.percentile(values, [50, upper, 100], method="higher"))


def differences(before: Sequence[Record], after: Sequence[Record]) -> list[str]:
    """Return a line for every problem of both campaigns whose maps or iteration counts differ."""
    earlier = {record["name"]: record for record in before}
    lines = []
    for record in after:
        other = earlier.get(record["name"], record)
        changed = [key for key in ("uv", "iterations", "status", "outcome") if other.get(key) != record.get(key)]
        if changed:
            lines.append(f"{record['name']}: " + ", ".join(f"{k} {other.get(k)} → {record.get(k)}" for k in changed))
    return lines


def _story(record: Record) -> str:
    """Describe a failure in a few words."""
    if "stages" not in record:
        return f"{record['outcome']}: {record.get('message', '')}"
    course = ", ".join(f"{before}→{after} ({count})" for _, count, before, after, _ in record["stages"])
    energy = record["energy"]
    tail = f", V₃/area {energy:.1e}" if energy is not None else ""
    return f"{record['outcome']}, {record['triangles']} triangles, flips by stage (iterations): {course}{tail}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, summarise or repeat; return 1 if any of the problems failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=1000, help="problems of the campaign (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("results.jsonl"), help="records (%(default)s)")
    parser.add_argument("--families", help="separated by commas (all of the kind)")
    parser.add_argument("--adversarial", action="store_true", help="families that aim at where programs break")
    parser.add_argument("--strategy", choices=STRATEGIES, default="speed", help="%(choices)s (%(default)s)")
    parser.add_argument("--max-iterations", type=int, default=2000, help="linear solves a problem (%(default)s)")
    parser.add_argument("--refine", action="store_true", help="split edges where there is no map without")
    parser.add_argument("--only-simple", action="store_true", help="only problems whose target is simple")
    parser.add_argument("-j", "--processes", type=int, default=1, help="problems at a time (%(default)s)")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds a problem (%(default)s)")
    parser.add_argument("--summary", type=Path, metavar="RESULTS", help="summarise records and end")
    parser.add_argument("--compare", type=Path, nargs=2, metavar="RESULTS", help="list the maps that differ and end")
    parser.add_argument("--case", action="append", metavar="NAME", help="run just this problem, e.g. maze:7:0.8")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write a table of refinement attempts")
    options = parser.parse_args(arguments)
    families = (
        options.families.split(",") if options.families else list(ADVERSARIAL if options.adversarial else FAMILIES)
    )
    unknown = [family for family in families if family not in _ALL]
    if unknown:
        parser.error(f"no family {', '.join(unknown)}; there are {', '.join(_ALL)}")
    for name in options.case or ():
        try:
            parse(name)
        except ValueError as error:
            parser.error(f"--case {name}: {error}")
    if options.compare:
        before, after = (read(path) for path in options.compare)
        lines = differences(before, after)
        print("\n".join([*lines, f"{len(lines)} of {len(after)} maps differ"]))
        return bool(lines)
    if options.summary and not options.summary.exists():
        parser.error(f"there is no file {options.summary}")

    if options.summary:
        records = read(options.summary)
    elif options.case:
        chosen = {"strategy": options.strategy, "max_iterations": options.max_iterations, "refine": options.refine}
        records = [run(name, **chosen) for name in options.case]
        print(*(json.dumps(record, indent=1) for record in records), sep="\n")
        return int(any(map(failed, records)))
    else:
        todo = list(names(options.count, families))
        try:
            for i, record in enumerate(
                campaign(
                    todo,
                    options.output,
                    processes=options.processes,
                    limit=options.limit,
                    strategy=options.strategy,
                    max_iterations=options.max_iterations,
                    refine=options.refine,
                    only_simple=options.only_simple,
                )
            ):
                if failed(record):
                    print(f"{record['name']}: {_story(record)}", file=sys.stderr)
                elif i % 500 == 499:
                    print(f"{i + 1} done", file=sys.stderr)
        except KeyboardInterrupt:
            print("interrupted; the same command goes on from here", file=sys.stderr)
        records = read(options.output)
    print(summary(records))
    if options.table:
        options.table.write_text(refinement_table(records) + "\n", encoding="utf-8")
    return int(any(map(failed, records)))


if __name__ == "__main__":
    sys.exit(main())
