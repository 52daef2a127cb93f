"""Success and message of a result, with the names of SciPy's `OptimizeResult`."""

from __future__ import annotations


class Outcome:
    """Base of results: `success`, `message`, and ``bool(result)``."""

    @property
    def success(self) -> bool:
        """Whether the call did what it promises: the map is certified injective, has not collapsed, and is complete."""
        raise NotImplementedError

    @property
    def message(self) -> str:
        """The outcome in one or two sentences, and what to do if it is not a success."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.message.partition(chr(10))[0]}>"

    def __bool__(self) -> bool:
        """Return `success`."""
        return self.success


class SummarisedOutcome(Outcome):
    """Base of results whose `message` is the first line of their `summary`."""

    def summary(self) -> str:
        """Describe the result in one or several lines."""
        raise NotImplementedError

    @property
    def message(self) -> str:
        """The first line of `summary`."""
        return self.summary().partition("\n")[0]
