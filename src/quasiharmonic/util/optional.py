"""Packages that only some functions need."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def explain_missing(need: str, package: str) -> Iterator[None]:
    """Say in an ImportError of the block what needs the package, and what to install.

    ``need`` is a clause such as "NIfTI files need nibabel", and ``package`` is what follows ``pip install``.
    """
    try:
        yield
    except ImportError as error:
        raise type(error)(f"{need}: pip install {package} ({error})") from error
