"""Data sets solved on a real Dask cluster of processes that communicate over TCP."""

from __future__ import annotations

import signal
import sys
import time

import pytest

from quasiharmonic import batch
from quasiharmonic.ui.batch.pool import attend
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.cli import main
from shared.dask_cluster import cluster
from shared.datasets import lasting, record_of, write_stars

pytestmark = pytest.mark.long

pytest.importorskip("distributed")


def test_a_worker_killed_during_a_problem(tmp_path, quick_workers):
    names = [f"{i:02d}" for i in range(10)]
    source = write_stars(tmp_path / "set", names, rings=7)
    killed = []
    with cluster(tmp_path, 2) as (address, _, workers):

        def kill_one(progress):
            if progress.done >= 3 and not killed:
                workers[0].kill()
                killed.append(progress.done)

        progress = batch.run(source, tmp_path / "out", scheduler=address, callback=kill_one)
        assert killed
        assert killed[0] < len(names)
        workers[0].join()
        assert workers[0].exitcode == -signal.SIGKILL
        assert workers[1].is_alive()
        assert progress.outcomes == {"injective": len(names)}
        # Run the command on the remaining worker of the cluster.
        assert main(["batch", str(source), "-o", str(tmp_path / "out"), "--scheduler", address]) == 0
    assert batch.run(source, tmp_path / "out").resumed == len(names)
    batch.run(source, tmp_path / "local")
    for name in names:
        assert lasting(record_of(tmp_path / "out", name)) == lasting(record_of(tmp_path / "local", name))


def test_problems_that_kill_workers_are_identified_and_affect_no_other(tmp_path):
    source = write_stars(tmp_path / "set", ["a", "b", "poison", "x", "y"])
    settings = {"distributed.scheduler.allowed-failures": 0}
    with cluster(tmp_path, 3, **settings) as (address, _, workers):
        progress = batch.run(source, tmp_path / "out", scheduler=address)
        assert progress.outcomes == {"injective": 4, "crash": 1}
        assert "died" in record_of(tmp_path / "out", "poison")["error"]
        # The scheduler notices the end of a worker before its parent process does.
        end = time.monotonic() + 60
        while sum(not worker.is_alive() for worker in workers) < 2:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert sum(not worker.is_alive() for worker in workers) == 2
    assert batch.run(source, tmp_path / "out").resumed == 5


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
    with pytest.raises(ImportError, match=r"pip install '.*\[dask\]'"):
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
