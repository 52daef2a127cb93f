"""The exact verdict on a map with seams: on each island, and on overlaps between islands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.geometry.exact import certificate
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite
from quasiharmonic.io.objects import MeshLike, as_seamed_mesh
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh, which_island
from quasiharmonic.util.arrays import FloatArray, IntArray, count_of, names_of
from quasiharmonic.util.hints import make_dataframe
from quasiharmonic.util.outcome import Verdict, as_plain

if TYPE_CHECKING:
    from pandas import DataFrame

#: Factor that reflects a map about the v axis.
MIRROR = np.array([-1.0, 1.0])


@dataclass(frozen=True, eq=False)
class IslandReport:
    """Base of the reports on one island: its triangles (k,), ascending, and whether it is mirrored."""

    triangles: IntArray
    mirrored: bool

    def to_dict(self) -> dict[str, Any]:
        """The report for JSON, with the first triangle and the number of triangles."""
        return {
            "first_triangle": int(self.triangles[0]),
            "triangles": len(self.triangles),
            "mirrored": self.mirrored,
        }


@dataclass(frozen=True, eq=False)
class IslandVerdict(IslandReport):
    """The verdict on one island, in the mesh's numbering.

    Attributes
    ----------
    triangles : (k,) int64
        Triangles of the island, ascending.
    mirrored : bool
        Whether every triangle is strictly negative, as in an island that was mirrored on purpose. The reflection is
        then certified. A single island is never called mirrored, but inverted.
    certificate : Certificate
        The certificate, in the island's own numbering.
    inverted : (a,) int64
        Triangles that are not strictly positive (mirrored islands: not strictly negative).

    See Also
    --------
    atlas.AtlasVerdict : Lists them as ``islands``.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> (island,) = atlas.certify(atlas.SeamedMesh(V, F, uv=V)).islands
    >>> island.mirrored, island.certificate.injective, island.inverted.tolist()
    (False, True, [])
    """

    certificate: Certificate
    inverted: IntArray

    @property
    def injective(self) -> bool:
        """Whether all triangles are strictly positive, or all strictly negative."""
        return self.certificate.injective

    @property
    def bijective(self) -> bool:
        """Whether the island is injective and does not overlap itself."""
        return bool(self.certificate.bijective)

    def summary(self) -> str:
        """Describe the verdict in one line."""
        where = which_island(self.triangles)
        turned = ", mirrored" if self.mirrored else ""
        if not self.injective:
            return f"{where}{turned}: not injective, {names_of('triangle', 'triangles', self.inverted)} not positive"
        return f"{where}{turned}: injective, {'bijective' if self.bijective else 'but it overlaps itself'}"

    def to_dict(self) -> dict[str, Any]:
        """The verdict for JSON, with the first triangle and the number of triangles."""
        return {
            **super().to_dict(),
            **as_plain(self, "injective", "bijective", "inverted"),
            "reasons": [reason.text for reason in self.certificate.reasons],
        }


@dataclass(frozen=True, eq=False, repr=False)
class AtlasVerdict(Verdict):
    """The verdict on a map with seams, made by `certify`.

    Attributes
    ----------
    islands : tuple of IslandVerdict
        Verdicts, in the order of each island's first triangle.
    overlapping : (p, 2) int64
        Pairs of bijective islands that share points of the plane, as indices of ``islands``; at most 1000.

    See Also
    --------
    atlas.certify : Makes it.
    Certificate : The verdict on a map without seams.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> verdict = atlas.certify(atlas.SeamedMesh(V, F, uv=V))
    >>> verdict.valid, len(verdict.overlapping)
    (True, 0)
    """

    islands: tuple[IslandVerdict, ...]
    overlapping: IntArray

    @property
    def valid(self) -> bool:
        """Whether every triangle has the sign of its island, and none is degenerate; equal to `injective`."""
        return self.injective

    @property
    def injective(self) -> bool:
        """Whether there are islands and all are injective."""
        return bool(self.islands) and all(island.injective for island in self.islands)

    @property
    def bijective(self) -> bool:
        """Whether there are islands and each one is bijective; overlaps between islands are not included."""
        return bool(self.islands) and all(island.bijective for island in self.islands)

    @property
    def inverted(self) -> IntArray:
        """Triangles with a sign other than their island's, ascending."""
        return np.sort(np.concatenate([np.empty(0, dtype=np.int64), *(island.inverted for island in self.islands)]))

    @property
    def mirrored(self) -> IntArray:
        """Indices of islands whose triangles are all negative."""
        return np.flatnonzero([island.mirrored for island in self.islands])

    def summary(self) -> str:
        """Describe the verdict, with mirrored, overlapping and not bijective islands."""
        count = len(self.islands)
        injective = sum(island.injective for island in self.islands)
        bijective = sum(island.bijective for island in self.islands)
        lines = [f"{count_of('island', 'islands', count)}: {injective} injective, {bijective} bijective."]
        if self.mirrored.size:
            lines.append(f"Mirrored, every triangle negative: {names_of('island', 'islands', self.mirrored)} (from 0).")
        if len(self.overlapping):
            first = ", ".join(f"{one} and {other}" for one, other in self.overlapping[:5].tolist())
            more = f", … ({len(self.overlapping)} pairs in all)" if len(self.overlapping) > 5 else ""
            lines.append(f"Islands overlap or touch each other: {first}{more} (from 0).")
        lines += [f"- {island.summary()}" for island in self.islands if not island.bijective][:10]
        return "\n".join(lines)

    def to_dataframe(self) -> DataFrame:
        """Return one row per island: size, mirrored, injective, bijective, inverted triangles; needs pandas."""
        rows = [island.to_dict() for island in self.islands]
        names = "first_triangle", "triangles", "mirrored", "injective", "bijective"
        columns = {name: [row[name] for row in rows] for name in names}
        return make_dataframe({**columns, "inverted": [len(row["inverted"]) for row in rows]}, "island")

    def to_dict(self) -> dict[str, Any]:
        """The verdict for JSON."""
        return {
            **super().to_dict(),
            "injective": self.injective,
            "islands": [island.to_dict() for island in self.islands],
            "overlapping": self.overlapping.tolist(),
        }


def certify(mesh: SeamedMesh | MeshLike, *, weld: bool | float = False) -> AtlasVerdict:
    """Certify a map with seams exactly, island by island.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
        Triangles without a position belong to no island and are not certified.
    weld : bool or float
        Whether vertices at equal positions count as one where they are at one position in the plane, or a distance
        relative to the diagonal of the bounding box within which they do; see `SeamedMesh.weld`.

    Returns
    -------
    AtlasVerdict

    Raises
    ------
    ValueError
        If ``weld`` is negative or not finite.

    See Also
    --------
    quasiharmonic.certify : A map without seams.
    atlas.AtlasVerdict : The verdict.

    Examples
    --------
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> print(certify(SeamedMesh(V, F, uv=V)).summary())
    1 island: 1 injective, 1 bijective.
    """
    mesh = as_seamed_mesh(mesh).weld(weld)
    judged = []
    for island, mirrored in zip(mesh.islands, mirrored_islands(mesh), strict=True):
        found = certificate.certify(island.F[:, ::-1] if mirrored else island.F, island.uv)
        wrong = np.sort(np.concatenate([found.inverted, found.degenerate, found.nonfinite]))
        judged.append(IslandVerdict(island.triangles, mirrored, found, island.triangles[wrong]))
    return AtlasVerdict(tuple(judged), _find_overlaps(mesh.islands, judged))


def mirrored_islands(mesh: SeamedMesh) -> list[bool]:
    """Which islands are mirrored; a single island is never called mirrored."""
    return [len(mesh.islands) > 1 and is_mirrored(island.F, island.uv) for island in mesh.islands]


def reflect_mirrored(mesh: SeamedMesh) -> SeamedMesh:
    """Reflect the mirrored islands of a map, for measurements that do not depend on positions."""
    turned = zip(mesh.islands, mirrored_islands(mesh), strict=True)
    return mesh.with_places([island.uv * MIRROR if mirrored else island.uv for island, mirrored in turned])


def is_mirrored(F: IntArray, uv: FloatArray) -> bool:
    """Whether every triangle is strictly negative."""
    return bool((orientation_or_nonfinite(*uv[F].swapaxes(0, 1))[0] < 0).all())


def _find_overlaps(islands: Sequence[Island], judged: Sequence[IslandVerdict]) -> IntArray:
    """Pairs of bijective islands that are not bijective together."""
    # Maximum number of pairs listed; stacked islands can overlap in all pairs.
    max_pairs = 1000
    sound = [k for k, verdict in enumerate(judged) if verdict.bijective]
    if len(sound) < 2:
        return np.empty((0, 2), dtype=np.int64)
    low = np.array([islands[k].uv.min(axis=0) for k in sound])
    high = np.array([islands[k].uv.max(axis=0) for k in sound])
    pairs: list[tuple[int, int]] = []
    for row, k in enumerate(sound):
        near = (low[row + 1 :] <= high[row]).all(axis=1) & (high[row + 1 :] >= low[row]).all(axis=1)
        for other in np.flatnonzero(near) + row + 1:
            if len(pairs) == max_pairs:
                break
            if not _are_disjoint(islands[k], islands[sound[other]], judged[k].mirrored, judged[sound[other]].mirrored):
                pairs.append((k, sound[other]))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _are_disjoint(one: Island, other: Island, mirrored: bool, also: bool) -> bool:
    """Whether two bijective islands share no point of the plane."""
    F = np.concatenate([one.F[:, ::-1] if mirrored else one.F, (other.F[:, ::-1] if also else other.F) + len(one.uv)])
    return bool(certificate.certify(F, np.concatenate([one.uv, other.uv])).bijective)
