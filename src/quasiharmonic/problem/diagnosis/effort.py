"""A budget for the time that a diagnosis takes."""

from __future__ import annotations

from dataclasses import dataclass

from quasiharmonic.util.progress import heartbeat


class EffortSpentError(Exception):
    """The budget is exhausted."""


@dataclass
class Effort:
    """A budget of time, and the amount spent so far, in units of about a microsecond."""

    limit: int
    spent: int = 0

    def spend(self, amount: int) -> None:
        """Spend an amount before the work; raise `EffortSpentError`, now and later, if the budget is exhausted."""
        heartbeat()
        self.spent += amount
        if self.spent > self.limit:
            raise EffortSpentError
