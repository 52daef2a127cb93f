"""The question: a surface, which of its vertices are held, and where these go."""

from __future__ import annotations

from quasiharmonic.problem.domain import Domain
from quasiharmonic.problem.frame import Frame
from quasiharmonic.problem.posing import Problem

__all__ = ["Domain", "Frame", "Problem"]
