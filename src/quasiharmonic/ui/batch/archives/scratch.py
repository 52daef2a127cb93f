"""Folder for the files of problems that are being solved."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from quasiharmonic.ui.batch.shards import Shard

_PREFIX = "qhm-batch-"


@contextmanager
def scratch_folder(output: Path, part: Shard, *, shared: bool) -> Iterator[Path]:
    """Make a folder for the block: in the run's folder if other machines must see it, else for temporary files.

    The folder of a killed run of the same shard is deleted first; a file in the run's folder has its path.
    """
    note = output / f"{_PREFIX}{part.label}.scratch"
    with suppress(OSError, ValueError):
        left = Path(note.read_text(encoding="utf-8"))
        if left.name.startswith(_PREFIX):
            shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=output if shared else None))
    try:
        note.write_text(str(folder), encoding="utf-8")
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        note.unlink(missing_ok=True)
