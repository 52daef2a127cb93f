"""The question and the answer: a surface with fixed vertices and their targets, the result, and why there is no map.

The package builds on `geometry` and `linsolve`. Start reading in `domain`, then `problem`; `result` is the answer, and
`diagnosis` names what forbids a map.
"""

from __future__ import annotations

from quasiharmonic.problem.domain import Domain
from quasiharmonic.problem.frame import Frame
from quasiharmonic.problem.problem import Problem

__all__ = ["Domain", "Frame", "Problem"]
