"""Data sets whose problems are files in folders."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.problems import ProblemFiles, find_problems
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.shards import Shard
from quasiharmonic.ui.batch.supervisor import Finished


class LooseProblems:
    """Problems of a data set whose results are files in the run's folder.

    Parameters
    ----------
    source : path
        As for `find_problems`.
    orders : Orders
        Parameters of the run.
    shard : Shard
        The shard of the data set to solve.

    Attributes
    ----------
    total : int
        Number of problems; ValueError if the data set has none, or one lies in the output folder.
    """

    def __init__(self, source: str | os.PathLike[str], orders: Orders, shard: Shard) -> None:
        self._source, self._shard = source, shard
        self.orders = orders
        # The problems are enumerated several times, so that memory does not grow with their number.
        self.total = self._count()

    def problems(self) -> Iterator[ProblemFiles]:
        """Yield the problems, in the order of their names."""
        return (files for files in self._all() if self._shard.contains(files.name))

    def collect(self, item: Finished | None) -> Iterable[Finished]:
        """Return the problems that are finished with an item of the pool."""
        return () if item is None else (item,)

    def close(self) -> None:
        """Do nothing: finished results are in their folders."""

    def records(self) -> Iterator[records.Record]:
        """Yield the records of the finished problems."""
        for files in self.problems():
            record = records.read_record(self.orders.folder(files))
            if record is not None:
                yield record

    def _all(self) -> Iterator[ProblemFiles]:
        return find_problems(self._source, plain=self.orders.settings.plain)

    def _count(self) -> int:
        folder: Path = self.orders.output
        none, count, inside = True, 0, folder.is_relative_to(os.path.abspath(self._source))
        for files in self._all():
            if inside and files.mesh.is_relative_to(folder):
                raise ValueError(f"{folder} contains a problem, {files.mesh}: choose another folder for the results")
            none = False
            count += self._shard.contains(files.name)
        if none:
            raise ValueError(
                f"no problems in {self._source}: a problem is a folder with input.obj (or .ply) and handles.txt"
                + (
                    ""
                    if self.orders.settings.plain
                    else "; for plain meshes, give an outline, or flatten or unwrap them"
                )
            )
        return count
