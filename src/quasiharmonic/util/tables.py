"""Tables of results as DataFrames of pandas."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from quasiharmonic.util.optional import explain_missing

if TYPE_CHECKING:
    from pandas import DataFrame


def make_dataframe(columns: Mapping[str, Any], index: str) -> DataFrame:
    """Return a DataFrame of columns of equal length, with an index of the given name that counts from 0."""
    with explain_missing("a DataFrame needs pandas", "'quasiharmonic[pandas]'"):
        import pandas
    frame = pandas.DataFrame(dict(columns))
    frame.index.name = index
    return frame
