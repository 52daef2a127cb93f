"""``qhm batch``: map every problem of a data set, and write a record of each.

Map every problem of a data set, each in a separate process: a failure does not affect other problems. Maps and
records are in OUT/results, each written as soon as it is finished; in the end OUT/records.csv has all records. To
continue an interrupted run, give the same command again. With --unwrap, every model gets texture coordinates, as by
qhm unwrap; the records list charts, stretch, used texture and what was cleaned.

Exit status: 0 every problem has a certified injective map (--flatten, --unwrap: bijective); 1 some have not (the
records give the reason); 2 wrong call, or stopped: finished results are kept; 3 finished, but the report failed.

    qhm batch problems/ -o results/ --report
    qhm batch meshes/ -o flat/ --flatten --cut -j 4
    qhm batch models/ -o unwrapped/ --unwrap --max-stretch 1.3 --report
    qhm batch -o results/ --report --against other.csv
    qhm batch problems/ -o results/ --shard $SLURM_ARRAY_TASK_ID/16
    qhm batch -o results/ --merge --report
"""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import map_options, process, report
from quasiharmonic.ui.cli.arguments import (
    SHARED,
    add_options,
    byte_count,
    choice,
    convert,
    count,
    declare_options,
    file,
    flag,
    number,
    pick,
    text,
    texture_size,
)
from quasiharmonic.ui.cli.process import tell
from quasiharmonic.util.options import ENERGIES, FLATTENED, MAP_FORMATS, DescentOptions, UnwrapOptions

if TYPE_CHECKING:
    from quasiharmonic.ui.batch import Progress

# The options of `unwrap` that are not options of a run.
_UNWRAP = {name: one for name, one in declare_options(UnwrapOptions).items() if name not in ("jobs", "time_limit")}
#: Seconds between two updates of the line on a terminal.
LIVE = 0.1


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        "source",
        metavar="DIR_OR_LIST",
        type=_location,
        nargs="?",
        help="folder with problems (input.obj or .ply, handles) at any depth, archives of problems (.tar, .parquet; a "
        "folder of them, data-{0000..0015}.tar, or a URL), or a text file that lists folders, meshes or archives, one "
        "per line; may be omitted with --report",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=_location,
        required=True,
        metavar="OUT",
        help="folder for the results; a URL is possible if the problems are in archives",
    )
    add_options(
        parser,
        report=flag(
            "write OUT/report.html: success, distortion and times of the run, with images of the slowest, worst and "
            "failed problems; without DIR_OR_LIST, the run is the folder or the table (.csv, .parquet) that -o names"
        ),
        against=file(
            "for --report: compare with another run, or with a table about another program, with the columns problem "
            "and seconds",
            metavar="OTHER",
        ),
        table=choice(("csv", "parquet"), "format of the table of records (default: csv)", default="csv"),
        map_format=choice(
            MAP_FORMATS, "format of the maps (default: obj); binary ply is written and read faster", default="obj"
        ),
        retry=flag("retry problems that failed by an error, a crash or a limit"),
        shard=text(
            "I/N",
            "solve shard I (1 to N) of N disjoint shards, for array jobs; they may share OUT and run at the same time",
        ),
        merge=file(
            "join the tables of finished shards in the folders RUN (default: OUT) into OUT/records.csv",
            metavar="RUN",
            nargs="*",
        ),
    )
    work = parser.add_argument_group("workers and limits")
    work.add_argument(
        "-j", "--jobs", type=count, metavar="N", help="problems solved in parallel (default: one per core)"
    )
    add_options(
        work,
        threads=number(count, "solver threads per problem (default: 1)", default=1),
        scheduler=text("ADDRESS", "use the workers of the Dask cluster with this scheduler, tcp://HOST:PORT"),
        time_limit=number(
            _seconds,
            "time limit per problem in seconds; 0 for no limit (default: 600)",
            metavar="SECONDS",
            default=600.0,
        ),
        memory_limit=number(byte_count, "limit of resident memory per problem, such as 800M or 4G", metavar="SIZE"),
    )
    solver = parser.add_argument_group("solution of each problem, as for qhm map or qhm flatten")
    add_options(
        solver,
        to=text("OUTLINE", f"map every mesh file onto an outline: {map_options.FORMS}"),
        flatten=flag("flatten every mesh file with a free boundary, without overlap"),
        cut=flag("with --to and --flatten: cut surfaces that cannot be flattened, along seams"),
        start=flag("for --flatten: start from the map in the files' texture coordinates"),
        pack=flag("with --to and --flatten: pack the islands into the unit square by their shapes"),
        energy=choice(FLATTENED, "energy that --flatten lowers (default: symmetric-dirichlet)"),
        polish=choice(ENERGIES, "lower the distortion of each injective map: %(choices)s", metavar="ENERGY"),
    )
    of_outlines = {
        name: SHARED[name] | {"help": f"for --to: {SHARED[name]['help']}"} for name in ("corners", "corner_angle")
    }
    add_options(solver, "slide", "font", **of_outlines)
    add_options(solver, "pieces", "refine", strategy=SHARED["strategy"] | {"default": None})
    add_options(solver, **declare_options(DescentOptions))
    add_options(solver, "reference", "max_iterations", "linear_solver")
    models = parser.add_argument_group("texture coordinates of each model, as for qhm unwrap")
    add_options(
        models,
        unwrap=flag("unwrap every mesh file: charts with little stretch, packed into a texture"),
        resolution=number(texture_size, "side of the texture in texels, or WIDTHxHEIGHT (default: 2048)"),
        # The defaults are those of `unwrap`; the limits of a run are options of their own.
        **{name: one | {"default": None} for name, one in _UNWRAP.items()},
    )


def run(options: argparse.Namespace) -> int:
    """Run the data set with progress, then print a summary and write the report page."""
    from quasiharmonic.ui import batch
    from quasiharmonic.ui.batch import places
    from quasiharmonic.ui.batch.shards import read_shard, table_name

    if options.against is not None and not options.report:
        raise ValueError("--against needs --report: add --report, or omit --against")
    if options.merge is not None:
        return _merge(options)
    if options.source is None:
        if not options.report:
            raise ValueError("name a folder or a list of problems, or add --report to describe a run")
        return _write_report(options)
    if options.flatten and options.strategy is not None:
        raise ValueError("--strategy needs a given boundary, but --flatten leaves the boundary free: omit one of them")
    if options.report:
        _folder(options)
    options.strategy = options.strategy or "speed"
    options.pieces = None if options.pieces is None else str(options.pieces)
    options.unwrap = _unwrap_options(options)
    settings = batch.Settings(**pick(options, *(one.name for one in fields(batch.Settings))))
    limits = pick(options, "jobs", "threads", "memory_limit")
    rest = pick(options, "retry", "table", "shard", "scheduler")
    time_limit = options.time_limit or None
    try:
        with process.progress_line(_words, live=LIVE) as show:
            progress = batch.run(
                options.source, options.output, settings, time_limit=time_limit, callback=show, **limits, **rest
            )
    except KeyboardInterrupt:
        tell(
            f"qhm batch: interrupted; finished results are kept in {options.output}; give the same command to continue"
        )
        return 2
    wanted = "bijective" if options.flatten or settings.unwrap is not None else "injective"
    records = places.join(options.output, table_name(read_shard(options.shard), options.table))
    with report.after_writing(records):
        print(_account(progress, wanted, records), flush=True)
        if options.report:
            _write_report(options)
    return 0 if progress.solved == progress.total else 1


def _unwrap_options(options: argparse.Namespace) -> dict[str, Any] | None:
    """Return the given options of `unwrap`, or None without --unwrap."""
    given = {name: value for name, value in pick(options, "resolution", *_UNWRAP).items() if value is not None}
    if options.unwrap:
        return given | ({"symmetry": None} if given.get("symmetry") == "none" else {})
    for name in given:
        raise ValueError(f"--{name.replace('_', '-')} applies only to --unwrap: add --unwrap, or omit it")
    return None


def _merge(options: argparse.Namespace) -> int:
    """Merge tables, print a summary and write the report page; return the exit status."""
    from quasiharmonic.ui import batch

    if options.source is not None or options.shard is not None:
        raise ValueError("--merge joins finished runs: omit the data set and --shard")
    folder = _folder(options)
    merged = batch.merge(options.merge or [folder], folder, table=options.table)
    table = folder / f"records.{options.table}"
    with report.after_writing(table):
        print(f"{merged.solved} of {merged.total} problems have a certified map\nwrote {table}", flush=True)
    if merged.missing:
        shown = ", ".join(merged.missing[:20]) + (", …" if len(merged.missing) > 20 else "")
        tell(f"qhm batch: warning: no table of the shards {shown}: they are not finished, or in another folder")
    if options.report:
        with report.after_writing(table):
            _write_report(options)
    return 0 if merged.solved == merged.total and not merged.missing else 1


def _folder(options: argparse.Namespace) -> Path:
    """Return the output, which must not be a URL."""
    if not isinstance(options.output, Path):
        raise ValueError(
            "--report and --merge need a folder on this machine, not a URL: copy the table of records there"
        )
    return options.output


def _write_report(options: argparse.Namespace) -> int:
    """Write the page about a run or a table of records; return the exit status."""
    from quasiharmonic.ui.report import write_report

    output = _folder(options)
    folder = output if output.is_dir() else output.parent
    page = folder / "report.html"
    write_report(page, output, options.against)
    return report.tell_written(page)


def _account(progress: Progress, wanted: str, table: str) -> str:
    from quasiharmonic.ui.batch import OUTCOMES

    failures = [
        f"{progress.outcomes[outcome]} {words}"
        for outcome, words in OUTCOMES.items()
        if outcome != wanted and progress.outcomes.get(outcome)
    ]
    lines = [f"{progress.solved} of {progress.total} problems have a certified {wanted} map"]
    lines += ["the others: " + ", ".join(failures)] if failures else []
    resumed = f", {progress.resumed} of them done before" if progress.resumed else ""
    lines.append(f"wrote {table} in {_duration(progress.seconds)}{resumed}")
    return "\n".join(lines)


def _words(progress: Progress) -> str:
    text = f"{progress.done}/{progress.total} done   {progress.failed} failed   {progress.rate:.3g}/s"
    left = progress.seconds_left
    return text if left is None else f"{text}   {_duration(left)} left"


def _duration(seconds: float) -> str:
    rounded = round(seconds)
    if rounded < 60:
        return f"{seconds:.2g} s" if seconds < 9.5 else f"{rounded} s"
    if rounded < 3600:
        return f"{rounded // 60} min {rounded % 60} s"
    return f"{rounded // 3600} h {rounded % 3600 // 60} min"


def _location(text: str) -> str | Path:
    """Return a URL as text, anything else as a path."""
    return text if "://" in text else Path(text)


def _seconds(text: str) -> float:
    return convert(text, float, lambda value: 0 <= value < float("inf"), "a time in seconds")
