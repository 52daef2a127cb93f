"""A recorder for the steps reported to a callback."""

from __future__ import annotations


class DistinctSteps(list):
    """A list of steps that ignores consecutive repetitions, which callbacks receive during long steps."""

    def append(self, step):
        if not (self and self[-1] is step):
            super().append(step)
