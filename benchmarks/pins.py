"""Solve thousands of problems with pins and a free boundary, feasible by construction; report success and time.

    python benchmarks/pins.py -n 2000 -o pins.jsonl [--scans FOLDER] [--families swirl,bend]
    python benchmarks/pins.py --summary pins.jsonl
    python benchmarks/pins.py --case swirl:7 [--scans FOLDER]

`pin_problems` makes the problems. Each problem adds one line of JSON when it is done; problems in the file are skipped.
The program may be interrupted or killed at any time and started again. A problem is *solved* if the map is certified
bijective and every pin is exactly at its target position. An exception or a warning counts as a failure. Seconds are
CPU seconds of one process, from arrays to a map of converged distortion; ``placing`` is wall time until the map was
bijective.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from campaign import read
from pin_problems import FAMILIES, make
from quasiharmonic import certify, flatten

Record = dict[str, Any]


def names(count: int, families: Sequence[str]) -> list[str]:
    """Return names of the first problems, families in turn."""
    return [f"{families[i % len(families)]}:{i // len(families)}" for i in range(count)]


def run(name: str, scans: Sequence[Path]) -> Record:
    """Make and solve one problem; catch every exception except those that end the process."""
    record: Record = {"name": name, "family": name.partition(":")[0]}
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            began = time.process_time()
            case = make(name, scans)
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
    parser.add_argument("--scans", type=Path, help="a folder of OBJ files, of which half of the surfaces are patches")
    parser.add_argument("--summary", type=Path, metavar="RESULTS", help="summarise records and end")
    parser.add_argument("--case", action="append", metavar="NAME", help="run just this problem, e.g. swirl:7")
    options = parser.parse_args(arguments)
    families = options.families.split(",")
    unknown = [family for family in families if family not in FAMILIES]
    if unknown:
        parser.error(f"no family {', '.join(unknown)}; there are {', '.join(FAMILIES)}")
    if options.summary and not options.summary.exists():
        parser.error(f"there is no file {options.summary}")
    scans = [] if options.scans is None else sorted(options.scans.rglob("*.obj"))

    if options.summary:
        records = read(options.summary)
    elif options.case:
        records = [run(name, scans) for name in options.case]
        print(*(json.dumps(record, indent=1) for record in records), sep="\n")
        return int(any(record["outcome"] != "solved" for record in records))
    else:
        records = _campaign(names(options.count, families), options.output, scans)
    print(summary(records))
    return int(any(record["outcome"] != "solved" for record in records))


def _campaign(todo: Sequence[str], output: Path, scans: Sequence[Path]) -> list[Record]:
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
                record = run(name, scans)
                file.write(json.dumps(record) + "\n")
                file.flush()
                if record["outcome"] != "solved":
                    print(f"{name}: {_story(record)}", file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from here", file=sys.stderr)
    return read(output)


if __name__ == "__main__":
    sys.exit(main())
