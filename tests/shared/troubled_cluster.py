"""Loaded by the workers of a test's cluster: problems with certain names kill the worker, or hang."""

from __future__ import annotations

import os
import signal
import time

from quasiharmonic.batch.keeper import Keeper
from quasiharmonic.io.errors import OutputError

plain_attend = getattr(Keeper.attend, "plain", Keeper.attend)


def attend(keeper, files):
    if "poison" in files.name:
        os.kill(os.getpid(), signal.SIGKILL)
    if "hang" in files.name:
        time.sleep(600)
    if files.name == "full":
        raise OutputError("cannot write full: No space left on device")
    if files.name == "mistake":
        return attend(keeper, files)
    return plain_attend(keeper, files)


# Dask loads this file more than once.
attend.plain = plain_attend
Keeper.attend = attend
