"""A Dask cluster of processes that start quickly: copies of a process that has imported Dask and the library."""

from __future__ import annotations

import importlib
import json
import os
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

from shared.quick_processes import quick_context

PRELOAD = Path(__file__).with_name("failing_cluster.py")


def run_command(kind, arguments, settings):
    """Do what ``dask KIND ARGUMENTS`` does, silently."""
    import dask

    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    with dask.config.set(settings):
        importlib.import_module(f"distributed.cli.dask_{kind}").main(arguments)


@contextmanager
def cluster(folder, workers, **settings):
    """A scheduler and single-threaded workers: address, scheduler process, worker processes."""
    context = quick_context()
    scheduler_file = folder / "scheduler.json"

    def start(kind, *arguments):
        process = context.Process(
            target=run_command, args=(kind, ["--scheduler-file", str(scheduler_file), *arguments], settings)
        )
        process.start()
        stack.callback(process.join)
        stack.callback(process.kill)
        return process

    with ExitStack() as stack:
        scheduler = start("scheduler", "--port", "0", "--no-dashboard", "--interface", "lo")
        options = "--no-nanny", "--nthreads", "1", "--no-dashboard", "--preload", str(PRELOAD)
        running = [start("worker", *options, "--local-directory", str(folder)) for _ in range(workers)]
        deadline = time.monotonic() + 60
        while not scheduler_file.exists() or not scheduler_file.read_text():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        address = json.loads(scheduler_file.read_text())["address"]
        assert address.startswith("tcp://")
        yield address, scheduler, running
