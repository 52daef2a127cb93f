"""Headers of ITK's files (MetaImage and NRRD): a file must contain its own data, and not announce too many of them."""

from __future__ import annotations

from math import prod

from quasiharmonic.util.untrusted import check_size

# Bytes in which a header must end.
_LONGEST = 1 << 20


def check_header(data: bytes, suffix: str) -> None:
    """Raise a ValueError if a file of this suffix refers to another file, or announces too much data.

    ITK's readers follow the name of a data file to any place.
    """
    entries = _entries(data, suffix)
    other = next((entries[key] for key in ("elementdatafile", "data file", "datafile") if key in entries), "LOCAL")
    if other.upper() != "LOCAL":
        raise ValueError(f"refers to the data file {ascii(other)[:80]}: save the data in the file itself")
    sides = (entries.get("dimsize") or entries.get("sizes") or "").split()
    if all(side.isdecimal() for side in sides):
        components = entries.get("elementnumberofchannels", "1")
        count = prod(map(int, sides)) * (int(components) if components.isdecimal() else 1)
        check_size(8 * count, "the header announces")


def _entries(data: bytes, suffix: str) -> dict[str, str]:
    """Return the entries of a header: MetaImage's ends with the entry ElementDataFile, NRRD's with an empty line."""
    entries: dict[str, str] = {}
    for line in data[:_LONGEST].split(b"\n"):
        if "elementdatafile" in entries or (suffix != ".mha" and not line.strip()):
            break
        key, _, value = line.decode("latin-1").partition("=" if suffix == ".mha" else ":")
        entries[key.strip().lower()] = value.strip()
    return entries
