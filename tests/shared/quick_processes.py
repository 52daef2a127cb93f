"""Processes of `multiprocessing` that start quickly: copies of a process that has imported the library and Dask."""

from __future__ import annotations

import multiprocessing
import os
from multiprocessing.context import BaseContext

# Names that cannot be imported are passed over.
IMPORTS = [
    "distributed.cli.dask_scheduler",
    "distributed.cli.dask_worker",
    "quasiharmonic.ui.batch.pool",
    "quasiharmonic.ui.batch.supervisor",
    "quasiharmonic.ui.batch.worker",
]


def quick_context() -> BaseContext:
    """Return a context of `multiprocessing` like "spawn", without the imports."""
    if os.name != "posix":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(IMPORTS)
    return context
