"""Data sets: thousands of problems, on one machine or on a cluster, none lost; their records and a report of them."""

from quasiharmonic.batch.driver import Progress, run
from quasiharmonic.batch.keeper import WorkerError
from quasiharmonic.batch.problems import ProblemFiles, find_problems
from quasiharmonic.batch.records import COLUMNS, OUTCOMES, read_table, write_table
from quasiharmonic.batch.report import write_report
from quasiharmonic.batch.settings import Settings

__all__ = [
    "COLUMNS",
    "OUTCOMES",
    "ProblemFiles",
    "Progress",
    "Settings",
    "WorkerError",
    "find_problems",
    "read_table",
    "run",
    "write_report",
    "write_table",
]
