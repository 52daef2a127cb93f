"""``qhm report``: write the records of a run as an HTML page."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.ui.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "report",
        help="write a report page of a qhm batch run",
        description="Write one HTML file about a finished or unfinished run of qhm batch: success, distortion, times, "
        "the slowest, worst and failed problems with pictures. It opens without network.",
        epilog="Exit status: 0 written; 2 the records cannot be read or the page cannot be written.",
    )
    parser.add_argument(
        "records", type=Path, metavar="OUT", help="folder of a run, or a table of records (.csv, .parquet)"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="HTML", help="file to write (default: report.html beside)")
    parser.add_argument(
        "--against",
        type=Path,
        metavar="OTHER",
        help="compare with another run, or a table about another program with the columns problem and seconds",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Write the page."""
    from quasiharmonic.ui.cli import report
    from quasiharmonic.ui.report import write_report

    folder: Path = options.records if options.records.is_dir() else options.records.parent
    output = options.output or folder / "report.html"
    write_report(output, options.records, options.against)
    with report.after_writing(output):
        print(f"wrote {output}", flush=True)
    return 0
