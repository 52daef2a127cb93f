"""Hints of errors: which name a user may have meant, and which package to install.

Also results as DataFrames of pandas, an optional package.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pandas import DataFrame


def suggest(given: object, known: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the known name that is nearest to a given one; empty if none is near."""
    from difflib import get_close_matches

    near = get_close_matches(given, list(known), n=1) if isinstance(given, str) else []
    return f"; did you mean {near[0]}?" if near else ""


@contextmanager
def explain_missing(need: str, package: str = "", *, extra: str = "", hint: str = "") -> Iterator[None]:
    """Add to an ImportError of the block what needs the package, and the command that installs it.

    ``need`` is a clause such as "NIfTI files need nibabel". ``package`` is what follows ``pip install``, unless an
    ``extra`` of this package is named. ``hint`` is added to the command.
    """
    try:
        yield
    except ImportError as error:
        wanted = with_extra(extra) if extra else package
        raise type(error)(f"{need}: pip install {wanted}{hint} ({error})") from error


def with_extra(name: str) -> str:
    """Return what follows ``pip install`` to install this package again from where it came, with an extra."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from pathlib import Path
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    try:
        origin = json.loads(distribution("quasiharmonic").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        origin = {"url": "file:"}
    if not origin:
        return f"'quasiharmonic[{name}]'"
    if "vcs_info" in origin:
        return f"'quasiharmonic[{name}] @ {origin['vcs_info']['vcs']}+{origin['url']}'"
    path = url2pathname(urlsplit(origin["url"]).path)
    return f"'{path}[{name}]'" if path and Path(path).exists() else f"'.[{name}]' in the folder of the source"


def make_dataframe(columns: Mapping[str, Any], index: str) -> DataFrame:
    """Return a DataFrame of columns of equal length, with an index of the given name that counts from 0."""
    with explain_missing("a DataFrame needs pandas", extra="pandas"):
        import pandas
    frame = pandas.DataFrame(dict(columns))
    frame.index.name = index
    return frame
