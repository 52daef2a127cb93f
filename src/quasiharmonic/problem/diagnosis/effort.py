"""A budget for the time that a diagnosis takes."""

from __future__ import annotations

from dataclasses import dataclass

from quasiharmonic.util.progress import heartbeat


class EffortSpentError(Exception):
    """The budget is exhausted."""


@dataclass
class Effort:
    """A budget of time, in units of about a microsecond.

    Attributes
    ----------
    most : int
        The budget.
    spent : int
        The amount spent so far.
    """

    most: int
    spent: int = 0

    def spend(self, amount: int) -> None:
        """Spend an amount; call this before the work.

        Raises
        ------
        EffortSpentError
            If the budget is exhausted; then every later call raises it too.
        """
        heartbeat()
        self.spent += amount
        if self.spent > self.most:
            raise EffortSpentError
