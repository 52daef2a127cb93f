"""Names that users may have meant."""

from __future__ import annotations

from collections.abc import Iterable


def suggest(given: object, known: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the known name that is nearest to a given one; empty if none is near."""
    from difflib import get_close_matches

    near = get_close_matches(given, list(known), n=1) if isinstance(given, str) else []
    return f"; did you mean {near[0]}?" if near else ""
