"""Ways to descend an objective over ξ, one a file.

Each is a function ``method(objective, start, visit, …)``: it calls ``visit`` with every `Iterate` it
arrives at, ``start`` excepted, until it has done its iterations or ``visit`` raises `Stop`.
"""

from __future__ import annotations

from quasiharmonic.result import Status


class Stop(Exception):  # noqa: N818 - a signal, not an error
    """Raised by ``visit`` to end the descent.

    Attributes
    ----------
    status : Status
        Why.
    """

    def __init__(self, status: Status) -> None:
        super().__init__(status.value)
        self.status = status
