"""How many examples Hypothesis generates."""

from __future__ import annotations

from hypothesis import settings


def examples(count, **options):
    """Settings for some examples, always the same ones; with `--nightly`, for ten times as many new ones."""
    return settings(max_examples=count if settings.default.derandomize else 10 * count, **options)
