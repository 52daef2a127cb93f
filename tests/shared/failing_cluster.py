"""Loaded by the workers of a test cluster: problems with certain names kill the worker, hang or raise errors."""

from __future__ import annotations

import os
import signal
import time

from quasiharmonic.io import OutputError
from quasiharmonic.ui.batch.supervisor import Supervisor

plain_attend = getattr(Supervisor.attend, "plain", Supervisor.attend)


def attend(supervisor, files):
    if "poison" in files.name:
        os.kill(os.getpid(), signal.SIGKILL)
    if "hang" in files.name:
        time.sleep(600)
    if files.name == "full":
        raise OutputError("cannot write full: No space left on device")
    if files.name == "mistake":
        return attend(supervisor, files)
    return plain_attend(supervisor, files)


# Dask loads this file more than once, so keep the original function.
attend.plain = plain_attend
Supervisor.attend = attend
