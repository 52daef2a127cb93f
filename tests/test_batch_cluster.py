"""Data sets solved on a real Dask cluster of processes that communicate over TCP."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from quasiharmonic import batch
from quasiharmonic.ui.batch.cluster import attend
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.cli import main
from shared.datasets import lasting, record_of, write_stars

pytestmark = pytest.mark.slow

pytest.importorskip("distributed")

PRELOAD = Path(__file__).with_name("shared") / "failing_cluster.py"


@contextmanager
def cluster(folder, workers, **environment):
    """A scheduler and single-threaded workers: address, scheduler process, worker processes."""
    environment = {**os.environ, **environment}
    told = folder / "scheduler.json"

    def start(kind, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", str(told), *arguments]
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        stack.callback(process.wait)
        stack.callback(process.kill)
        return process

    with ExitStack() as stack:
        scheduler = start("scheduler", "--port", "0", "--no-dashboard", "--interface", "lo")
        options = "--no-nanny", "--nthreads", "1", "--no-dashboard", "--preload", str(PRELOAD)
        running = [start("worker", *options, "--local-directory", str(folder)) for _ in range(workers)]
        deadline = time.monotonic() + 60
        while not told.exists() or not told.read_text():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        address = json.loads(told.read_text())["address"]
        assert address.startswith("tcp://")
        yield address, scheduler, running


def test_a_worker_killed_during_a_problem(tmp_path):
    source = write_stars(tmp_path / "set", [f"{i:02d}" for i in range(16)], rings=9)
    killed = []
    with cluster(tmp_path, 3) as (address, _, workers):

        def kill_one(progress):
            if progress.done >= 4 and not killed:
                workers[0].send_signal(signal.SIGKILL)
                killed.append(progress.done)

        progress = batch.run(source, tmp_path / "out", scheduler=address, callback=kill_one)
        assert killed
        assert killed[0] < 16
        assert workers[0].wait() == -signal.SIGKILL
        assert workers[1].poll() is workers[2].poll() is None
        assert progress.outcomes == {"injective": 16}
        # Run the command on the remaining workers of the cluster.
        assert main(["batch", str(source), "-o", str(tmp_path / "out"), "--scheduler", address]) == 0
    assert batch.run(source, tmp_path / "out").resumed == 16
    batch.run(source, tmp_path / "local")
    for name in (f"{i:02d}" for i in range(16)):
        assert lasting(record_of(tmp_path / "out", name)) == lasting(record_of(tmp_path / "local", name))


def test_problems_that_kill_workers_are_identified_and_affect_no_other(tmp_path):
    source = write_stars(tmp_path / "set", ["a", "b", "c", "poison", "x", "y", "z"])
    with cluster(tmp_path, 4, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (address, _, workers):
        progress = batch.run(source, tmp_path / "out", scheduler=address)
        assert progress.outcomes == {"injective": 6, "crash": 1}
        assert "died" in record_of(tmp_path / "out", "poison")["error"]
        assert sum(worker.poll() is not None for worker in workers) == 2
    assert batch.run(source, tmp_path / "out").resumed == 7


def test_errors_that_end_the_run(tmp_path):
    """A full disk, an internal error, and folders that a worker cannot see end the run."""
    source = write_stars(tmp_path / "set", ["a", "full", "mistake"])
    with cluster(tmp_path, 1) as (address, _, _):
        with pytest.raises(OSError, match=r"cannot write .*full.*o space left"):
            batch.run(source / "full", tmp_path / "out", scheduler=address)
        with pytest.raises(RuntimeError, match="RecursionError in a worker"):
            batch.run(source / "mistake", tmp_path / "out", scheduler=address)
        assert batch.run(source / "a", tmp_path / "out", scheduler=address).solved == 1
    (problem,) = batch.find_problems(source / "a")
    seen = attend(problem, Orders(tmp_path / "elsewhere", batch.Settings()))
    assert isinstance(seen, OSError)
    assert "a file system that all machines share" in str(seen)


def test_a_client_and_a_lost_scheduler(tmp_path):
    from distributed import Client

    source = write_stars(tmp_path / "set", ["a", "b", "hang"])
    with cluster(tmp_path, 1) as (address, scheduler, _), Client(address, set_as_default=False) as client:
        assert batch.run(source / "a", tmp_path / "one", scheduler=client).solved == 1

        def kill(progress):
            if progress.done == 2:
                scheduler.kill()

        with pytest.raises(ConnectionError, match="scheduler ended or dropped a problem"):
            batch.run(source, tmp_path / "out", scheduler=address, callback=kill)
    assert record_of(tmp_path / "out", "b")["certified"]


def test_no_scheduler(tmp_path, monkeypatch, capsys):
    source = write_stars(tmp_path / "set", ["a"])
    monkeypatch.setenv("DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT", "0.5s")
    import dask

    with dask.config.set({"distributed.comm.timeouts.connect": "0.5s"}):
        assert main(["batch", str(source), "-o", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert "no Dask scheduler at tcp://127.0.0.1:9" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"pip install 'quasiharmonic\[dask\]'"):
        batch.run(source, tmp_path / "out", scheduler="tcp://127.0.0.1:9")


@pytest.mark.parametrize("address", ["nonsense", "tcp://host", "http://host:1", "tcp://host:port"])
def test_invalid_addresses_are_rejected_at_once(tmp_path, capfd, address):
    source = write_stars(tmp_path / "set", ["a"])
    import dask

    began = time.monotonic()
    with dask.config.set({"distributed.comm.timeouts.connect": "600s"}):
        assert main(["batch", str(source), "-o", str(tmp_path / "out"), "--scheduler", address]) == 2
    error = capfd.readouterr().err
    assert f"'{address}' is not the address of a Dask scheduler, such as tcp://HOST:8786" in error
    assert "Traceback" not in error
    assert time.monotonic() - began < 300
