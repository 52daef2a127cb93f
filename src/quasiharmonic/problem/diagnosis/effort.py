"""What is spent on looking, and when there is no more of it."""

from __future__ import annotations

from dataclasses import dataclass

from quasiharmonic.util.progress import heartbeat


class EffortSpentError(Exception):
    """More would be spent than may be."""


@dataclass
class Effort:
    """A measure of the time spent, in about microseconds.

    Attributes
    ----------
    most : int
        What may be spent.
    spent : int
        What has been.
    """

    most: int
    spent: int = 0

    def spend(self, amount: int) -> None:
        """Spend an amount, before what it is spent on.

        Raises
        ------
        EffortSpentError
            When there is not so much left; from then on at every call.
        """
        heartbeat()
        self.spent += amount
        if self.spent > self.most:
            raise EffortSpentError
