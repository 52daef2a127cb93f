"""Data sets with failures: each failure is recorded and does not affect other problems."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from quasiharmonic import batch
from quasiharmonic.ui.batch import supervisor
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.cli import main
from shared.commands import FAILING_WORKER, linux
from shared.datasets import lasting, record_of, star_of, write_problem, write_stars

pytestmark = pytest.mark.long

WORKER = supervisor.COMMAND


def children_of(process):
    """Process ids of a driver's child processes."""
    found = []
    for task in Path(f"/proc/{process.pid}/task").iterdir():
        with suppress(OSError):  # the thread may have ended meanwhile
            found += (task / "children").read_text().split()
    return found


def runs(child):
    """Whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{child}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


class TestTroubles:
    def test_every_failure_is_recorded_and_affects_no_other_problem(self, tmp_path, failing_worker, quick_workers):
        kinds = ["bug", "exit", "killed", "late", "noise", "refused", "segfault", "sleep", "spin"]
        source = write_stars(tmp_path / "set", [name for kind in kinds for name in (kind, f"{kind[:2]}~")])
        (source / "broken").mkdir()
        (source / "broken" / "input.obj").write_text("v 0 0 0\nf 1 2 3\n")
        progress = batch.run(source, tmp_path / "out", jobs=2, time_limit=2)
        found = {record["problem"]: record for record in batch.read_table(tmp_path / "out" / "records.csv")}
        assert len(found) == progress.total == progress.done
        expected = {
            "sleep": ("timeout", "not finished within 2 s"),
            "spin": ("timeout", "not finished within 2 s"),
            "refused": ("memory", ""),
            "late": ("memory", "out of memory"),
            "segfault": ("crash", "ended by SIGSEGV.*Segmentation fault"),
            "killed": ("crash", "ended by SIGKILL"),
            "exit": ("crash", "exit code 3"),
            "bug": ("error", "KeyError: 'lost'"),
            "broken": ("invalid", "input.obj"),
        }
        for name, record in found.items():
            outcome, words = expected.get(name, ("injective", ""))
            assert record["outcome"] == outcome, name
            assert record["certified"] == (outcome == "injective")
            assert re.search(words, record["error"] or "")
            if outcome == "timeout":
                assert 2 <= record["seconds"] < 60
        assert progress.failed == len(expected)

    def test_a_record_that_another_program_has_open_fails_alone(
        self, tmp_path, failing_worker, quick_workers, monkeypatch
    ):
        """As on Windows; the next run tries the problem again."""
        source = write_stars(tmp_path / "set", ["a", "z_in_use"])
        progress = batch.run(source, tmp_path / "out", jobs=1)
        assert progress.outcomes == {"injective": 1, "error": 1}
        assert [row["problem"] for row in batch.read_table(tmp_path / "out" / "records.csv")] == ["a"]
        monkeypatch.setattr(supervisor, "COMMAND", WORKER)
        again = batch.run(source, tmp_path / "out", jobs=1)
        assert again.resumed == 1
        assert again.outcomes == {"injective": 2}

    @linux
    def test_a_problem_beyond_the_memory_limit_is_recorded(self, tmp_path, failing_worker, quick_workers):
        source = write_stars(tmp_path / "set", ["a", "hog", "z"])
        progress = batch.run(source, tmp_path / "out", jobs=1, time_limit=60, memory_limit=300 << 20)
        assert progress.outcomes == {"injective": 2, "memory": 1}
        record = record_of(tmp_path / "out", "hog")
        assert record["error"] == "used more than 300 MiB of memory"
        assert 300 << 20 < record["peak_memory"] < 600 << 20

    def test_a_mesh_exceeds_the_limits_of_time_and_memory(self, tmp_path, quick_workers):
        """Real limits: a mesh exceeds the time limit, and then the memory limit."""
        source, out = tmp_path / "set", tmp_path / "out"
        write_problem(source / "small", *star_of(4))
        assert batch.run(source, out, jobs=1).outcomes == {"injective": 1}
        write_problem(source / "large", *star_of(150))
        limited = batch.run(source, out, jobs=1, time_limit=0.1)
        assert (limited.outcomes, limited.resumed) == ({"timeout": 1, "injective": 1}, 1)
        # With the same limit or a lower one the problem is not solved again.
        assert batch.run(source, out, jobs=1, time_limit=0.05).resumed == 2
        if Path("/proc/self/statm").exists():
            limited = batch.run(source, out, jobs=1, memory_limit=40 << 20)
            assert (limited.outcomes, limited.resumed) == ({"memory": 1, "injective": 1}, 1)
        assert batch.run(source, out, jobs=1).outcomes == {"injective": 2}

    def test_failed_problems_are_solved_again_on_request(self, tmp_path, quick_workers, monkeypatch):
        source = write_stars(tmp_path / "set", ["a", "killed", "bug"])
        (source / "a" / "handles.txt").write_text("not a number")
        monkeypatch.setattr(supervisor, "COMMAND", FAILING_WORKER)
        assert batch.run(source, tmp_path / "out", jobs=1).outcomes == {"invalid": 1, "crash": 1, "error": 1}
        monkeypatch.setattr(supervisor, "COMMAND", WORKER)
        assert batch.run(source, tmp_path / "out", jobs=1).resumed == 3
        progress = batch.run(source, tmp_path / "out", jobs=1, retry=True)
        assert (progress.outcomes, progress.resumed) == ({"invalid": 1, "injective": 2}, 1)
        assert "error" not in record_of(tmp_path / "out", "bug")

    def test_a_full_disk_stops_the_run_with_a_message(self, tmp_path, failing_worker, quick_workers, monkeypatch):
        source = write_stars(tmp_path / "set", ["a", "b_full", "c_sleep", "d"])
        assert batch.run(source / "a", tmp_path / "out").solved == 1
        began = time.monotonic()
        with pytest.raises(OSError, match=r"cannot write .*b_full.*[Nn]o space left"):
            batch.run(source, tmp_path / "out", jobs=2)
        assert time.monotonic() - began < 120
        assert record_of(tmp_path / "out", "a")["certified"]
        assert not (tmp_path / "out/results/b_full/record.json").exists()
        assert not list((tmp_path / "out").rglob("*.tmp"))
        monkeypatch.setattr(supervisor, "COMMAND", WORKER)
        assert batch.run(source, tmp_path / "out", jobs=2).solved == 4

    def test_a_process_that_dies_idle_is_replaced(self, tmp_path, quick_workers, monkeypatch):
        begin, begun = supervisor.subprocess.Popen, []

        def recorded(*arguments, **options):
            begun.append(begin(*arguments, **options))
            return begun[-1]

        monkeypatch.setattr(supervisor.subprocess, "Popen", recorded)
        stars = write_stars(tmp_path / "set", ["a", "b"])
        (tmp_path / "out").mkdir()
        orders = Orders(tmp_path / "out", batch.Settings())
        one = supervisor.Supervisor(orders)
        try:
            first, second = batch.find_problems(stars)
            assert one.attend(first).outcome == "injective"
            (idle,) = begun
            idle.kill()
            idle.wait()
            assert one.attend(second).outcome == "injective"
            assert len(begun) == 2
        finally:
            one.close()


def test_a_closed_connection_is_not_blamed_on_a_problem(tmp_path):
    """If a driver is killed, both pipes to a worker close, and the worker may notice either first."""
    (problem,) = batch.find_problems(write_stars(tmp_path / "set", ["a"]))
    folder = tmp_path / "out"
    job = {
        "mesh": str(problem.mesh),
        "fixed": str(problem.fixed),
        "folder": str(folder),
        "time_limit": 60,
        "settings": batch.Settings().to_dict(),
        "record": {"problem": "a"},
    }
    with subprocess.Popen(supervisor.COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert json.loads(process.stdout.readline()) == {"ready": True}
        process.stdout.close()
        process.stdin.write(json.dumps(job).encode() + b"\n")
        process.stdin.flush()
        assert process.wait(60) == 0
    assert not list(folder.iterdir())


@linux
def test_a_killed_driver_loses_only_the_problems_in_progress(tmp_path, quick_workers):
    # The last two problems keep the driver busy until it is killed, however late that is.
    names = [*(f"{i:02d}" for i in range(14)), "y_sleep", "z_sleep"]
    source = write_stars(tmp_path / "set", names)
    out, straight = tmp_path / "killed", tmp_path / "straight"
    run = (
        "from quasiharmonic import batch; from quasiharmonic.ui.batch import supervisor; "
        f"supervisor.COMMAND, supervisor.TOGETHER = {FAILING_WORKER!r}, 1.0; batch.run({str(source)!r}, {str(out)!r}, "
        "jobs=2)"
    )
    driver = subprocess.Popen([sys.executable, "-c", run])
    while len(list(out.rglob("record.json"))) < 5:
        assert driver.poll() is None
        time.sleep(0.005)
    children = children_of(driver)
    driver.kill()
    driver.wait()
    deadline = time.monotonic() + 120
    while any(runs(child) for child in children):
        assert time.monotonic() < deadline, "processes were left behind"
        time.sleep(0.02)
    assert children
    done = {path.parent.name: json.loads(path.read_bytes()) for path in out.rglob("record.json")}
    assert 5 <= len(done) <= 14
    assert {record["outcome"] for record in done.values()} == {"injective"}
    stamps = {name: (out / "results" / name / "map.obj").stat().st_mtime_ns for name in done}
    assert main(["batch", str(source), "-j", "2", "-o", str(out)]) == 0
    assert batch.run(source, straight, jobs=2).solved == len(names)
    for name, stamp in stamps.items():
        assert (out / "results" / name / "map.obj").stat().st_mtime_ns == stamp
    for path in straight.rglob("map.obj"):
        name = path.parent.name
        assert (out / "results" / name / "map.obj").read_bytes() == path.read_bytes()
        assert lasting(record_of(out, name)) == lasting(record_of(straight, name))
    tables = [[lasting(row) for row in batch.read_table(folder / "records.csv")] for folder in (out, straight)]
    assert tables[0] == tables[1]
    assert len(tables[0]) == len(names)


@linux
def test_an_orphaned_process_that_hangs_is_ended(tmp_path, monkeypatch):
    """With the interpreter's lock taken, no thread notices that the driver is gone; the system ends the process."""
    write_stars(tmp_path / "set", ["spin"])
    script = (
        f"import sys, quasiharmonic.ui.batch.worker as w; w.GRACE = 0.5; exec(open({str(FAILING_WORKER[-1])!r}).read())"
    )
    run = (
        "import sys; from quasiharmonic import batch; from quasiharmonic.ui.batch import supervisor; "
        f"supervisor.COMMAND = [sys.executable, '-c', {script!r}]; "
        f"batch.run({str(tmp_path / 'set')!r}, {str(tmp_path / 'out')!r}, jobs=1, time_limit=1.5)"
    )
    driver = subprocess.Popen([sys.executable, "-c", run])
    while not (tmp_path / "out/results/spin").exists():
        assert driver.poll() is None
        time.sleep(0.02)
    children = children_of(driver)
    driver.kill()
    driver.wait()
    assert len(children) == 1
    deadline = time.monotonic() + 120
    while runs(children[0]):
        assert time.monotonic() < deadline
        time.sleep(0.05)
