"""Pipes of a process that computes for another process, which starts it, sends requests and decides when it ends."""

from __future__ import annotations

import faulthandler
import os
import signal
from collections.abc import Callable
from typing import BinaryIO

from quasiharmonic.util.threads import detach_input


def open_pipes() -> tuple[BinaryIO, Callable[[bytes], None]]:
    """Return the file of requests, and a function that sends an answer.

    If the other process is gone, sending ends this process: that is not an error of the request.
    """
    # Ctrl-C reaches the whole process group; the other process decides when this process ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)
    # Redirect standard output to standard error, so that output of libraries does not mix with the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def send(answer: bytes) -> None:
        try:
            answers.write(answer)
            answers.flush()
        except OSError:
            os._exit(0)

    return detach_input(), send
