"""Tables of results as DataFrames of pandas."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pandas import DataFrame


def make_dataframe(columns: Mapping[str, Any], index: str) -> DataFrame:
    """Return a DataFrame of columns of equal length, with an index of the given name that counts from 0."""
    try:
        import pandas
    except ImportError as error:
        raise ImportError(f"a DataFrame needs pandas ({error}): pip install 'quasiharmonic[pandas]'") from error
    frame = pandas.DataFrame(dict(columns))
    frame.index.name = index
    return frame
