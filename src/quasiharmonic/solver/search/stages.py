"""Stages of a strategy other than a plain `Descent`: on a coarse mesh, tentative, or conditional."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

from quasiharmonic.solver.methods.base import Descent, SearchStage

#: Stages of a strategy.
Stages: TypeAlias = Sequence[SearchStage]


@dataclass(frozen=True)
class CoarseToFine(SearchStage):
    """Stage that searches on a coarse mesh and transfers the map to the fine mesh; skipped if the mesh is small.

    ``first`` is the first stage on the coarse mesh; local repair and untangling follow.
    """

    first: Descent

    coarse: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return f"coarse-to-fine, {self.first.name}"

    @property
    def begins_with(self) -> Descent:
        """``first``."""
        return self.first


@dataclass(frozen=True)
class _DescentStage(SearchStage):
    """Stage that runs one descent under conditions of its own."""

    descent: Descent

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return self.descent.name

    @property
    def begins_with(self) -> Descent:
        """``descent``."""
        return self.descent


class TentativeStage(_DescentStage):
    """Stage whose iterations are discarded if it finds no map (§9.2). Later stages continue from the earlier state."""


class IfManyInverted(_DescentStage):
    """Stage that runs only if so many triangles are inverted that local repair would be slower."""
