"""What a callback is told."""

from __future__ import annotations


class Told(list):
    """Steps, without those that are told again because nothing new has come for a while."""

    def append(self, step):
        if not (self and self[-1] is step):
            super().append(step)
