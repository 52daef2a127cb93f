"""Data sets: thousands of problems, on one machine or on a cluster, none lost; their records and a report of them."""

from quasiharmonic.batch.driver import Progress, run
from quasiharmonic.batch.problems import ProblemFiles, find_problems
from quasiharmonic.batch.records import COLUMNS, OUTCOMES, read_table, write_table
from quasiharmonic.batch.settings import Settings
from quasiharmonic.batch.supervisor import WorkerError

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
    "write_table",
]
