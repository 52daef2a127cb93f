"""Packages that only some functions need.

One of them is pandas, for tables of results as DataFrames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pandas import DataFrame


@contextmanager
def explain_missing(need: str, package: str) -> Iterator[None]:
    """Say in an ImportError of the block what needs the package, and what to install.

    ``need`` is a clause such as "NIfTI files need nibabel", and ``package`` is what follows ``pip install``.
    """
    try:
        yield
    except ImportError as error:
        raise type(error)(f"{need}: pip install {package} ({error})") from error


def make_dataframe(columns: Mapping[str, Any], index: str) -> DataFrame:
    """Return a DataFrame of columns of equal length, with an index of the given name that counts from 0."""
    with explain_missing("a DataFrame needs pandas", "'quasiharmonic[pandas]'"):
        import pandas
    frame = pandas.DataFrame(dict(columns))
    frame.index.name = index
    return frame
