"""Read standard input in a thread."""

from __future__ import annotations

import os
from typing import BinaryIO


def detach_input() -> BinaryIO:
    """Return the process's standard input as a binary file, and leave the null device in its place.

    A thread may then read the file while other threads work: on Windows, a library's start-up code waits for standard
    input while a thread reads it, and the interpreter cannot close `sys.stdin` at exit.
    """
    source = os.fdopen(os.dup(0), "rb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    return source
