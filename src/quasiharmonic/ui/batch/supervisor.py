"""Supervise a worker process: enforce its limits, and replace it when it dies."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, BinaryIO, NamedTuple

from quasiharmonic.io.errors import FileInUseError, OutputError
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.problems import ProblemFiles
from quasiharmonic.ui.batch.records import Record
from quasiharmonic.ui.batch.settings import Orders

# Command of the worker process; -P prevents imports from the working directory.
COMMAND = [sys.executable, "-P", "-c", "from quasiharmonic.ui.batch.worker import serve; serve()"]
# Thread counts of OpenMP, MKL, OpenBLAS, BLIS and Apple's Accelerate.
_THREADS = "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"
# Seconds between two checks of time and memory, and seconds that a process may take to import its libraries.
_CHECK_INTERVAL = 0.05
_START = 120.0
#: Time limit in seconds for a group of small problems. It usually takes less than a second, and more on a busy machine.
TOGETHER = 20.0


class Finished(NamedTuple):
    """Report of a finished problem."""

    name: str
    outcome: str  # As in the record
    seconds: float  # As in the record
    resumed: bool = False  # Whether an earlier run had finished it
    starved: bool = False  # Whether it failed because memory ran out, or possibly so


class ClosedError(Exception):
    """The supervisor was closed while it solved a problem."""


class WorkerError(OSError):
    """A worker process could not be started."""


class Supervisor:
    """Solve one problem at a time in a separate process."""

    def __init__(self, orders: Orders) -> None:
        self.orders = orders
        self._process: _Process | None = None
        self._closed = False
        self._lock = threading.Lock()

    def attend(self, files: ProblemFiles, *, again: bool = False) -> Finished:
        """Ensure that a problem has a record of this input and these settings; solve it if necessary.

        With ``again``, solve it in a new process, and replace its record. OutputError if results cannot be written,
        WorkerError if no process can be started, ClosedError if `close` was called in the meantime.
        """
        if again:
            self.rest()
        job = self._job(files, again=again)
        return job if isinstance(job, Finished) else self._solve_one(job)

    def attend_all(self, some: Sequence[ProblemFiles]) -> Iterator[Finished]:
        """Like `attend` for small problems: solve them together where possible, and the rest one by one.

        A crash or timeout of a process that solves several problems is not recorded. Problems without a record are then
        solved one by one.

        Yields
        ------
        Finished
            In any order.
        """
        jobs: list[dict[str, Any]] = []
        for files in some:
            job = self._job(files)
            if isinstance(job, Finished):
                yield job
            else:
                jobs.append(job)
        if len(jobs) > 1:
            left = dict(enumerate(jobs))
            for k, finished in self._solved_together(jobs):
                del left[k]
                yield finished
            jobs = list(left.values())
        for job in jobs:
            yield self._solve_one(job)

    def _job(self, files: ProblemFiles, *, again: bool = False) -> dict[str, Any] | Finished:
        """Return the job for the process, or the outcome if there is nothing to do."""
        orders = self.orders
        folder = orders.folder(files)
        known = _start_record(files, orders)
        try:
            known["key"] = orders.settings.key(files)
        except OSError as error:
            return _conclude(folder, known | {"outcome": "invalid", "error": str(error)}, 0.0)
        before = None if again else records.read_record(folder)
        finished = None if before is None else find_resumed(files.name, before, known["key"], orders)
        if before is not None and finished is not None:
            data = records.read_map(orders.map_path(folder))
            if records.is_intact(before, data):
                return finished
        return {
            "mesh": str(files.mesh),
            "fixed": None if files.fixed is None else str(files.fixed),
            "folder": str(folder),
            "time_limit": orders.time_limit,
            "settings": orders.settings.to_dict(),
            "record": known,
        }

    def close(self) -> None:
        """Kill the process in any state; may be called from another thread."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.end()

    def _begin(self, job: dict[str, Any]) -> _Process:
        """Send a job to the process, and start the process if necessary."""
        with self._lock:
            if self._closed:
                raise ClosedError
            if self._process is not None and not self._process.lives():
                self._process.end()
                self._process = None
            self._process = process = self._process or _Process(self.orders.threads)
        try:
            process.await_ready()
        except WorkerError:
            if self._closed:
                raise ClosedError from None
            raise
        process.send(job)
        return process

    def _solved_together(self, jobs: list[dict[str, Any]]) -> Iterator[tuple[int, Finished]]:
        """Solve small problems together; yield the index and the outcome of each finished one."""
        limit = min(self.orders.time_limit or TOGETHER, TOGETHER)
        orders = replace(self.orders, time_limit=limit)
        process = self._begin({"together": jobs, "time_limit": limit})
        while True:
            answer, _ = process.answer(orders)
            if answer is None:
                self._replace_dead()
                return
            if "over" in answer:
                return
            k = answer["done"]
            yield k, Finished(jobs[k]["record"]["problem"], answer["outcome"], answer["seconds"])

    def _solve_one(self, job: dict[str, Any]) -> Finished:
        process = self._begin(job)
        began = time.perf_counter()
        record: Record = job["record"]
        while True:
            answer, why = process.answer(self.orders)
            if answer is None:
                break
            if "outcome" in answer:
                starved = answer["outcome"] == "memory"
                if starved:
                    # A failed allocation may leave the process in a bad state.
                    self.rest()
                return Finished(record["problem"], answer["outcome"], answer["seconds"], starved=starved)
            record = answer["facts"]
        self._replace_dead()
        starved = why["outcome"] == "memory" or process.was_killed
        return _conclude(Path(job["folder"]), record | why, time.perf_counter() - began)._replace(starved=starved)

    def _replace_dead(self) -> None:
        """Let the next job start another process; ClosedError if `close` has ended this one."""
        self.rest()
        if self._closed:
            raise ClosedError

    def rest(self) -> None:
        """Kill the process, which releases its memory; the next job starts another one."""
        with self._lock:
            if self._process is not None:
                self._process.end()
            self._process = None


def record_crash(files: ProblemFiles, orders: Orders, why: str) -> Finished:
    """Record a crash for a problem whose supervisor died too; OutputError if it cannot be written."""
    record = _start_record(files, orders) | {"outcome": "crash", "error": why}
    with suppress(OSError):
        record["key"] = orders.settings.key(files)
    return _conclude(orders.folder(files), record, 0.0)


def _start_record(files: ProblemFiles, orders: Orders) -> Record:
    """Return the part of a record that is known before the problem is read."""
    return {
        "problem": files.name,
        "source": files.source or str(files.mesh),
        "threads": orders.threads,
        "time_limit": orders.time_limit,
        "memory_limit": orders.memory_limit,
        "certified": False,
    }


def _conclude(folder: Path, record: Record, seconds: float) -> Finished:
    """Write the record of a problem whose process could not write it."""
    with suppress(FileInUseError):  # without a record the next run tries this problem again
        records.clear(folder)
        records.write_record(folder, record | {"seconds": seconds})
    return Finished(record["problem"], record["outcome"], seconds)


def find_resumed(name: str, record: Record, key: str, orders: Orders) -> Finished | None:
    """Return the report of a problem that an earlier run has finished; None if its record has not this key, or is void.

    The map of the record must be intact.
    """
    if record.get("key") != key or not is_valid(record, orders):
        return None
    return Finished(name, record["outcome"], record.get("seconds") or 0.0, resumed=True)


def is_valid(record: Record, orders: Orders) -> bool:
    """Whether an existing record of the same input and settings is valid for these orders, if its map is intact."""
    outcome = record["outcome"]
    if outcome in records.JUDGED or outcome == "invalid":
        return True
    if orders.retry:
        return False
    if outcome == "timeout":
        return orders.time_limit is not None and orders.time_limit <= record["time_limit"]
    if outcome == "memory" and record["memory_limit"] is not None:
        return orders.memory_limit is not None and orders.memory_limit <= record["memory_limit"]
    return True


class _Process:
    """Worker process with a pipe for jobs and a pipe for answers."""

    def __init__(self, threads: int) -> None:
        # The file position is shared with the process, which writes at the position that `send` sets.
        self._errors = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        environment = {**os.environ, **dict.fromkeys(_THREADS, str(threads))}
        try:
            self._process = subprocess.Popen(
                COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, env=environment
            )
        except OSError as error:
            self._errors.close()
            raise WorkerError(f"cannot start {COMMAND[0]}: {error}") from error
        self._answers: SimpleQueue[bytes | None] = SimpleQueue()
        self._ready = False
        #: Whether another program ended the process by SIGKILL, as the system does when memory runs out.
        self.was_killed = False
        assert self._process.stdout is not None
        threading.Thread(target=_pump, args=(self._process.stdout, self._answers), daemon=True).start()

    def await_ready(self) -> None:
        """Wait until the process has imported its libraries."""
        if self._ready:
            return
        with suppress(Empty):
            line = self._answers.get(timeout=_START)
            self._ready = line is not None
        if not self._ready:
            words = self._last_words()
            self.end()
            raise WorkerError(f"the process that solves problems did not start: {words}")

    def lives(self) -> bool:
        """Whether the process is running."""
        return self._process.poll() is None

    def send(self, job: dict[str, Any]) -> None:
        """Send a job."""
        self._began, self._peak = time.monotonic(), 0
        assert self._process.stdin is not None
        # If the process has died, the end of its answers shows it.
        with suppress(OSError):
            self._errors.truncate(0)
            self._errors.seek(0)
            self._process.stdin.write(json.dumps(job).encode() + b"\n")
            self._process.stdin.flush()

    def answer(self, orders: Orders) -> tuple[dict[str, Any] | None, Record]:
        """Wait for the next answer; return None and the cause if the process was ended instead.

        OutputError if results cannot be written.
        """
        while True:
            try:
                line = self._answers.get(timeout=_CHECK_INTERVAL)
            except Empty:
                why = self._check_limits(orders)
                if why is None:
                    continue
                self.end()
                return None, why | self._memory()
            if line is not None:
                answer = json.loads(line)
                if "stop" in answer:
                    raise OutputError(answer["stop"])
                return answer, {}
            self.was_killed = hasattr(signal, "SIGKILL") and self._process.wait() == -signal.SIGKILL
            return None, {"outcome": "crash", "error": self._cause()} | self._memory()

    def end(self) -> None:
        """Kill the process; only the current problem is lost."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        self._errors.close()

    def _check_limits(self, orders: Orders) -> Record | None:
        if orders.time_limit is not None and time.monotonic() - self._began > orders.time_limit:
            return {"outcome": "timeout", "error": f"not finished within {orders.time_limit:g} s"}
        self._peak = max(self._peak, resident(self._process.pid) or 0)
        if orders.memory_limit is not None and self._peak > orders.memory_limit:
            return {"outcome": "memory", "error": f"used more than {orders.memory_limit / 2**20:.0f} MiB of memory"}
        return None

    def _memory(self) -> Record:
        return {"peak_memory": self._peak or None}

    def _cause(self) -> str:
        code = self._process.returncode
        text = f"the process ended with exit code {code}"
        if code < 0:
            with suppress(ValueError):
                text = f"the process was ended by {signal.Signals(-code).name}"
            if self.was_killed:
                text += ", as the system does when memory runs out"
        words = self._last_words()
        return f"{text}: {words}" if words else text

    def _last_words(self) -> str:
        """Return the end of standard error, which may contain the cause of death, in one line."""
        if self._errors.closed:
            return ""
        self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(self._errors.tell() - 10_000, 0))
        words = " ".join(self._errors.read().decode("utf-8", "replace").split())
        _, fatal, tail = words.rpartition("Fatal Python error")
        return (fatal + tail)[:300] if fatal else tail[-300:]


def _pump(source: BinaryIO, answers: SimpleQueue[bytes | None]) -> None:
    with source, suppress(OSError, ValueError):
        for line in source:
            answers.put(line)
    answers.put(None)


def resident(pid: int) -> int | None:
    """Return the resident memory of a process in bytes, or None if it is not available."""
    with suppress(OSError, IndexError, ValueError, AttributeError):
        return int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    try:
        import psutil
    except ImportError:
        return None
    with suppress(psutil.Error):
        return int(psutil.Process(pid).memory_info().rss)
    return None
