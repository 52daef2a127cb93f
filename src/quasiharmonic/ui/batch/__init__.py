"""Run data sets of many problems on one machine or on a cluster, with a record for each problem.

The package builds on `solver` and `apps`. Start reading in `driver`, then `worker` for the work of one process.
"""

from quasiharmonic.ui.batch.driver import Progress, run
from quasiharmonic.ui.batch.problems import ProblemFiles, find_problems
from quasiharmonic.ui.batch.records import COLUMNS, OUTCOMES, read_table, write_table
from quasiharmonic.ui.batch.settings import Settings
from quasiharmonic.ui.batch.shards import Merged, merge
from quasiharmonic.ui.batch.supervisor import WorkerError

__all__ = [
    "COLUMNS",
    "OUTCOMES",
    "Merged",
    "ProblemFiles",
    "Progress",
    "Settings",
    "WorkerError",
    "find_problems",
    "merge",
    "read_table",
    "run",
    "write_table",
]
