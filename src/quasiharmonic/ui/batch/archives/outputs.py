"""Locations of the archives of results: in the run's folder, or by URL."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from quasiharmonic.ui.batch.archives import places
from quasiharmonic.ui.batch.archives.results import MAX_ABOUT, PART, is_parquet, parse_about, read_about
from quasiharmonic.ui.batch.archives.tar_stream import global_comment


class Outputs:
    """Archives of results.

    Parameters
    ----------
    folder : Path
        The run's folder. If there is a URL, it contains only archives that are not sent yet.
    url : str, optional
        Where finished archives are sent.
    """

    def __init__(self, folder: Path, url: str | None) -> None:
        self._folder = folder / "results"
        self._url = url

    def path(self, name: str) -> Path:
        """Return the path of an archive of results on this machine, which need not exist."""
        return self._folder / name

    def about(self, name: str) -> dict[str, Any] | None:
        """Return the metadata of a finished archive of results; None if there is none."""
        path = self.path(name)
        if self._url is None:
            return read_about(path)
        if not is_parquet(path):
            start = places.read_start(self._at(name), MAX_ABOUT)
            return None if start is None else parse_about(global_comment(start))
        with self.reading(name) as copy:
            return None if copy is None else read_about(copy)

    def bring(self, name: str) -> None:
        """Copy a finished archive of results by URL to this machine, in order to continue it."""
        if self._url is not None and places.read_start(self._at(name), 1) is not None:
            self.path(name).parent.mkdir(parents=True, exist_ok=True)
            places.fetch(self._at(name), self.path(name).parent)

    def publish(self, name: str) -> None:
        """Send a finished archive of results to the URL."""
        if self._url is not None:
            places.send(self.path(name), self._at(name))
            self.path(name).unlink()

    @contextmanager
    def reading(self, name: str) -> Iterator[Path | None]:
        """Return the path of a finished archive of results, or of its journal; None if there is neither."""
        if self._url is None:
            paths = self.path(name), self.path(name + PART)
            yield next((path for path in paths if path.is_file()), None)
            return
        with tempfile.TemporaryDirectory(prefix="qhm-batch-") as folder:
            try:
                yield places.fetch(self._at(name), Path(folder))
            except FileNotFoundError:
                yield None

    def adopt(self, name: str, present: frozenset[str], stamp: str) -> None:
        """Use the results of an archive that was moved within the data set.

        These results have the same file name, belong to no archive of the data set (``present``), and have the same
        ``stamp`` in their metadata. Unfinished results have no stamp, but each record has the key of its problem.
        """
        if self._url is not None or self.path(name).exists() or self.path(name + PART).exists():
            return
        for part in ("", PART):
            found = []
            for path in self._folder.rglob(os.path.basename(name) + part):
                old = path.relative_to(self._folder).as_posix().removesuffix(PART)
                if old not in present and (part or (read_about(path) or {}).get("stamp") == stamp):
                    found.append(path)
            if len(found) == 1:
                target = self.path(name + part)
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(found[0], target)
                return

    def _at(self, name: str) -> str:
        assert self._url is not None
        return places.join(self._url, f"results/{name}")
