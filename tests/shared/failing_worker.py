"""The worker process of `quasiharmonic.batch` with failures, chosen by the name of the problem."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import signal
import sys
import time
from pathlib import Path

from quasiharmonic.io import atomic
from quasiharmonic.ui.batch import groups, metadata, worker

replace = os.replace
fill_record, ready = worker.fill_record, groups.read_problem


def use_all_memory():
    blocks = []
    while True:
        # Slowly, so that a busy machine notices before it is far above the limit.
        blocks.append(b"\1" * (1 << 22))
        time.sleep(0.01)


def hang():
    """Hold the interpreter's lock within C, so that no other thread of the process can run."""
    if os.name == "posix":
        ctypes.PyDLL(None).sleep(600)
    else:
        re.match(r"(a+)+$", "a" * 60 + "b")


def raise_disk_full(*arguments):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def raise_in_use(old, new):
    if Path(new).name == "record.json" and "in_use" in str(new):
        error = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        error.winerror = 32  # as on Windows
        raise error
    replace(old, new)


def keep_in_use():
    atomic.os.replace, atomic.PATIENCE = raise_in_use, 0.2


def raise_memory_error(V, F, uv):
    raise MemoryError


def print_text():
    print("a library says hello")
    os.system("echo and so does another")
    sys.stdout.flush()


def kill_twice(mesh):
    """Kill this process, as the system does when memory runs out, but only the first two times for a mesh."""
    deaths = Path(mesh).with_name("deaths.txt")
    count = len(deaths.read_text()) if deaths.exists() else 0
    if count < 2:
        deaths.write_text("x" * (count + 1))
        os.kill(os.getpid(), signal.SIGKILL)


FAILURES = {
    "sleep": lambda: time.sleep(600),
    "spin": hang,
    "hog": use_all_memory,
    "refused": lambda: bytearray(1 << 62),
    "segfault": lambda: ctypes.string_at(0),
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "exit": lambda: sys.exit(3),
    "bug": lambda: {}["lost"],
    "noise": print_text,
    "late": lambda: setattr(metadata, "distortion", raise_memory_error),
    "in_use": keep_in_use,
    "full": lambda: setattr(atomic.os, "replace", raise_disk_full),
}


def fail_by_name(job):
    name = job["record"]["problem"]
    if "revived" in name:
        kill_twice(job["mesh"])
    for word, failure in FAILURES.items():
        if word in name:
            failure()


def fill_record_or_fail(job, folder, record, tell):
    fail_by_name(job)
    fill_record(job, folder, record, tell)


def prepare_batch_or_fail(job):
    fail_by_name(job)
    return ready(job)


worker.fill_record, groups.read_problem = fill_record_or_fail, prepare_batch_or_fail
worker.serve()
