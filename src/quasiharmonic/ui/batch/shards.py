"""Split a data set into disjoint shards, one for each job of an array."""

from __future__ import annotations

import re
from hashlib import blake2b
from typing import NamedTuple

from quasiharmonic.util.arrays import describe


class Shard(NamedTuple):
    """Part of a data set: the problems or archives whose names have this remainder."""

    number: int  # 1 to total
    total: int

    @property
    def label(self) -> str:
        """Text for file names, of constant length for all shards of an array."""
        return f"{self.number:0{len(str(self.total))}d}-of-{self.total}"

    def contains(self, name: str) -> bool:
        """Whether a problem or archive belongs to this shard; the same on all machines and in all runs."""
        digest = blake2b(name.encode("utf-8", "surrogateescape"), digest_size=8).digest()
        return int.from_bytes(digest, "little") % self.total == self.number - 1


#: The whole data set.
WHOLE = Shard(1, 1)


def read_shard(text: str | None) -> Shard:
    """Return the shard for ``"i/n"``, with i from 1 to n; the whole data set for None. ValueError if it is invalid."""
    if text is None:
        return WHOLE
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text) if isinstance(text, str) else None
    if found is None:
        raise ValueError(
            f"shard must be 'i/n', such as '3/16', not {text if isinstance(text, str) else describe(text)}"
        )
    shard = Shard(int(found[1]), int(found[2]))
    if not 1 <= shard.number <= shard.total:
        raise ValueError(f"shard {text}: the first number counts from 1 to the second")
    return shard


def table_name(shard: Shard, kind: str) -> str:
    """Return the file name of the table of records of a shard (its manifest), or of the whole data set."""
    return f"records.{kind}" if shard == WHOLE else f"records-{shard.label}.{kind}"


def shard_of(name: str) -> Shard | None:
    """Return the shard of a manifest's file name, `WHOLE` for that of the whole data set; None for other files."""
    found = re.fullmatch(r"records(?:-([0-9]+)-of-([0-9]+))?\.(?:csv|parquet)", name)
    return None if found is None else Shard(int(found[1] or 1), int(found[2] or 1))
