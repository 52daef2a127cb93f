"""The worker process of `quasiharmonic.batch` with failures, chosen by the name of the problem."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import signal
import sys
import time

from quasiharmonic.io import atomic
from quasiharmonic.ui.batch import batched as together
from quasiharmonic.ui.batch import metadata as account
from quasiharmonic.ui.batch import worker

fill_record, ready = worker.fill_record, together.ready


def hog():
    kept = []
    while True:
        kept.append(b"\1" * (1 << 22))
        time.sleep(0.001)


def full(*arguments):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def unmeasurable(V, F, uv):
    raise MemoryError


def noise():
    print("a library says hello")
    os.system("echo and so does another")
    sys.stdout.flush()


TROUBLES = {
    "sleep": lambda: time.sleep(600),
    # Runs in C and holds the interpreter's lock, so no other thread of the process can run.
    "spin": lambda: re.match(r"(a+)+$", "a" * 60 + "b"),
    "hog": hog,
    "refused": lambda: bytearray(1 << 62),
    "segfault": lambda: ctypes.string_at(0),
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "exit": lambda: sys.exit(3),
    "bug": lambda: {}["lost"],
    "noise": noise,
    "late": lambda: setattr(account, "distortion", unmeasurable),
    "full": lambda: setattr(atomic.os, "replace", full),
}


def befall(name):
    for word, trouble in TROUBLES.items():
        if word in name:
            trouble()


def troubled(job, folder, record, tell):
    befall(record["problem"])
    fill_record(job, folder, record, tell)


def troubled_with_others(job):
    befall(job["record"]["problem"])
    return ready(job)


worker.fill_record, together.ready = troubled, troubled_with_others
worker.serve()
