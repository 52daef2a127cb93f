"""Files that arrive as bytes, for functions that read paths."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def stored_file(name: str, content: bytes) -> Iterator[Path]:
    """Store a file under a name in a temporary folder during the block; return its path."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        yield path
