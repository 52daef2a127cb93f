"""Results and certificates: what all of them have, with the names of SciPy's `OptimizeResult`, and their display.

A result shows one line in a console, and a picture in a notebook. It does not import the code that draws it. Instead
the drawing package registers a function that imports it. This function is called when a result is displayed for the
first time.
"""

from __future__ import annotations

from math import isfinite

# Same effect as in `typing`, whose import would dominate the import time of the package.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from matplotlib.figure import Figure

_loader: Callable[[], Any] | None = None


def as_plain(owner: object, *names: str) -> dict[str, Any]:
    """Return attributes by name, fit for JSON: arrays as lists, and objects with ``to_dict`` as dictionaries."""
    return {name: _make_plain(getattr(owner, name)) for name in names}


def _make_plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_make_plain(one) for one in value]
    for convert in ("tolist", "to_dict"):
        if hasattr(value, convert):
            return getattr(value, convert)()
    return value


def replace_nonfinite(value: float) -> float | None:
    """Return a number for JSON, which has neither infinity nor NaN: None for these."""
    return value if isfinite(value) else None


class Verdict:
    """Base of certificates: an exact verdict on stored positions.

    ``valid`` tells whether every element is strictly positive, ``bijective`` whether in addition no point is covered
    twice (None if that was not checked). ``summary()`` and ``to_dict()`` describe the verdict.
    """

    if TYPE_CHECKING:

        @property
        def valid(self) -> bool: ...

        @property
        def bijective(self) -> bool | None: ...

    def summary(self) -> str:
        """Describe what is certified, or what is wrong and where."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        return as_plain(self, "valid", "bijective")

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.summary().partition(chr(10))[0]}>"


class BaseOutcome:
    """Base of results that succeed or fail; ``bool(result)`` is `success`."""

    @property
    def success(self) -> bool:
        """Whether the call did what it promises."""
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


class Outcome(BaseOutcome):
    """Base of results with a status and a certificate.

    A result has a ``status``, whose value is a message for the user, a ``certificate``, and the wall time ``seconds``.
    """

    if TYPE_CHECKING:

        @property
        def status(self) -> Any: ...

        @property
        def certificate(self) -> Any: ...

        @property
        def seconds(self) -> float: ...

    @property
    def message(self) -> str:
        """The outcome in one or two sentences, and what to do if it is not a success."""
        return str(self.status.value)

    @property
    def n_iterations(self) -> int:
        """Number of iterations; 0 for methods without any."""
        return 0

    def summary(self) -> str:
        """Describe the outcome in a few lines."""
        return f"{self.message}\n{self.certificate.summary()}"

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON, without arrays of positions."""
        return {
            "success": self.success,
            "status": self.status.name.lower(),
            **as_plain(self, "message", "n_iterations", "seconds", "certificate"),
        }


class OutcomeOf(Outcome):
    """Base of results that contain the result of a map, as ``result``."""

    if TYPE_CHECKING:

        @property
        def result(self) -> Outcome: ...

    @property
    def success(self) -> bool:
        """Whether the map is a success."""
        return self.result.success

    @property
    def status(self) -> Any:
        """The status of the map."""
        return self.result.status

    @property
    def certificate(self) -> Any:
        """The certificate of the map."""
        return self.result.certificate

    @property
    def seconds(self) -> float:
        """Wall time of the map."""
        return self.result.seconds

    @property
    def n_iterations(self) -> int:
        """Iterations of the map."""
        return self.result.n_iterations


class SummarisedOutcome(Outcome):
    """Base of results whose `message` is the first line of their `summary`."""

    def summary(self) -> str:
        """Describe the result in one or several lines."""
        raise NotImplementedError

    @property
    def message(self) -> str:
        """The first line of `summary`."""
        return self.summary().partition("\n")[0]


def register_renderer(loader: Callable[[], Any]) -> None:
    """Set the function that imports the drawing package.

    It returns an object with ``html(result) -> str`` and ``draw(result, kind, **options) -> Figure``.
    """
    global _loader
    _loader = loader


class Displayable:
    """Base class of results with a short text, a summary and a notebook picture."""

    def summary(self) -> str:
        """Describe the result in a few lines."""
        raise NotImplementedError

    def short_repr(self) -> str:
        """Describe the result in a few words."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.short_repr()}>"

    def _repr_html_(self) -> str:
        html: str = _renderer().html(self)
        return html

    def _draw(self, kind: str, **options: Any) -> Figure:
        """Draw one kind of figure of the result."""
        return _renderer().draw(self, kind, **options)


def _renderer() -> Any:
    """The drawing package, imported at the first call."""
    assert _loader is not None, "quasiharmonic/__init__.py registers it"
    return _loader()
