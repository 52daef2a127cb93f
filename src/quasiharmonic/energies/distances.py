"""Sampled distances along a surface, and the error with which a flat map reproduces them.

Brain mapping evaluates flat maps in this way. It compares distances along the surface with straight distances in the
plane, for vertices up to some number of rings apart. *Rings* count edges: two vertices are k rings apart if the
shortest path along edges has k edges. A reported figure should state the following choices:

- *Pairs*: sources are drawn at random among the vertices. Each is paired with all vertices within the given rings, or
  with a random sample of these. All pairs have the same weight, whatever the area of their vertices. Errors cluster: on
  a cortex of 9,465 vertices, a thousand sources leave an uncertainty of the mean of 0.3 % of the distances. To compare
  maps, use the same sample for each. For a figure to be published, use all vertices as sources.
- *Along the surface*: the length of the shortest chain of straight segments that each cross a bounded number of edges
  (`quasiharmonic.geometry.mesh.geodesics`). Chains do not cross cuts. They are never too short. On a folded surface
  they are 0.2 % too long on average with 5 crossings, and 0.6 % with 3.
- *In the plane*: the straight distance, whether or not the segment stays inside the map.
- *Scale*: the whole map is scaled by the factor that minimises the mean error.
- *Error*: ``|scale · d_plane / d_surface − 1|`` for each pair.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.geodesics import chain_lengths, edge_graph, neighbours_within, straight_segments
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_integer,
    check_range,
    index_array,
    map_array,
    morton_order,
    vertex_array,
)
from quasiharmonic.util.progress import heartbeat


@dataclass(frozen=True)
class Sampling:
    """Parameters of a distance sample; report them with every figure.

    Attributes
    ----------
    rings : int
        Maximum number of edges between the vertices of a pair.
    sources : int
        Number of source vertices.
    targets : int or None
        Maximum number of randomly drawn targets per source; None for all within the given rings.
    crossings : int
        Maximum number of edges that each straight segment of a path along the surface may cross.
    """

    rings: int
    sources: int
    targets: int | None
    crossings: int

    def summary(self) -> str:
        """Return the parameters as a sentence."""
        others = "all others" if self.targets is None else f"at most {self.targets} others"
        return (
            f"pairs of {self.sources} vertices with {others} at most {self.rings} edges away. Surface distances are "
            f"lengths of polylines whose segments cross at most {self.crossings} edges each; plane "
            f"distances are straight"
        )


@dataclass(frozen=True, eq=False)
class DistanceError:
    """Errors of a map's distances, as `SurfaceDistances.error` and `quasiharmonic.distortion` return them.

    Attributes
    ----------
    scale : float
        Factor applied to the map; it minimises `mean`.
    relative : (k,) float64
        ``scale · d_plane / d_surface − 1`` of every pair: positive where the map lengthens the distance.
    sampling : Sampling
        Parameters of the sample.

    See Also
    --------
    distortion : Returns it with ``rings``.
    energies.distances.SurfaceDistances : Distances to compare with.

    Examples
    --------
    >>> from quasiharmonic import distortion
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(4, 4)
    >>> round(distortion(V, F, 2 * V, rings=2).distances.scale, 6)
    0.5
    """

    scale: float
    relative: FloatArray
    sampling: Sampling

    @property
    def mean(self) -> float:
        """Mean absolute relative error; 0.15 if distances are 15 % off on average."""
        return float(np.abs(self.relative).mean())

    @property
    def median(self) -> float:
        """Median absolute relative error."""
        return float(np.median(np.abs(self.relative)))

    @property
    def rms(self) -> float:
        """Root-mean-square relative error, more sensitive to large errors than the mean."""
        return float(np.sqrt(np.mean(self.relative**2)))

    def to_dict(self) -> dict[str, Any]:
        """Return the errors and the parameters of the sample for JSON."""
        return {
            "mean": self.mean,
            "median": self.median,
            "rms": self.rms,
            "scale": self.scale,
            "pairs": int(self.relative.size),
            **vars(self.sampling),
            "sampling": self.sampling.summary(),
        }

    def summary(self) -> str:
        """Return the errors as a sentence."""
        return (
            f"distances off by {100 * self.mean:.3g} % on average (root mean square {100 * self.rms:.3g} %), the map "
            f"scaled by {self.scale:.4g}; {self.sampling.summary()}"
        )


@dataclass(frozen=True, eq=False)
class SurfaceDistances:
    """Distances along a surface between pairs of its vertices, as `surface_distances` returns them.

    Attributes
    ----------
    source, target : (k,) int64
        Vertices; sources ascending.
    length : (k,) float64
        Distances along the surface, positive.
    sampling : Sampling

    See Also
    --------
    energies.distances.surface_distances : Makes it.
    results.DistanceError : The errors of a map's distances.

    Examples
    --------
    >>> from quasiharmonic.energies.distances import surface_distances
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(4, 4)
    >>> distances = surface_distances(V, F, rings=1)
    >>> round(float(distances.length.min()), 6)
    0.25
    """

    source: IntArray
    target: IntArray
    length: FloatArray
    sampling: Sampling

    def error(self, uv: ArrayLike) -> DistanceError:
        """Compare the distances with those in the plane, for a map (n, 2) that need not be injective."""
        positions = map_array("uv", uv)
        check_range("a pair", np.concatenate([self.source, self.target]), len(positions))
        difference = positions[self.source] - positions[self.target]
        ratio = np.hypot(difference[:, 0], difference[:, 1]) / self.length
        scale = _best_scale(ratio)
        return DistanceError(scale, scale * ratio - 1, self.sampling)


@accepts_mesh
def surface_distances(
    V: ArrayLike,
    F: ArrayLike,
    *,
    rings: int = 20,
    sources: int = 1000,
    targets: int | None = None,
    crossings: int = 5,
    seed: int = 0,
) -> SurfaceDistances:
    """Sample distances along a surface.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles of a surface, consistently oriented.
    rings : int
        Maximum number of edges between the vertices of a pair.
    sources : int
        Number of source vertices, drawn at random without repetition; all vertices if there are no more.
    targets : int, optional
        Maximum number of targets per source, drawn at random; by default all within the given rings.
    crossings : int
        Maximum number of edges that each straight segment of a path may cross; see the module's description.
    seed : int
        Seed of the random draws. The same surface and arguments give the same sample.

    Returns
    -------
    SurfaceDistances
        In the unit of ``V``.

    Raises
    ------
    ValueError
        When an array has the wrong shape, an index is out of range, a coordinate is not finite, a triangle has no area,
        or a number is not a whole number of at least 1 (``crossings`` and ``seed``: at least 0).

    See Also
    --------
    keep_distances : Lowers the error of distances.
    distortion : Measures it with ``rings``.

    Examples
    --------
    >>> from quasiharmonic.energies.distances import surface_distances
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(4, 4)
    >>> distances = surface_distances(V, F, rings=2)
    >>> bool(abs(distances.error(V).relative).max() < 1e-12)
    True
    """
    V, F = vertex_array(V), index_array("F", F)
    if F.ndim != 2 or F.shape[1] != 3 or not len(F):
        raise ValueError(f"F must have shape (f, 3) with at least one triangle, not {F.shape}")
    check_range("F", F, len(V))
    for name, value in (("rings", rings), ("sources", sources)):
        check_integer(name, value, minimum=1)
    for name, value in (("crossings", crossings), ("seed", seed)):
        check_integer(name, value, minimum=0)
    if targets is not None:
        check_integer("targets", targets, minimum=1)
    return sample_distances(V, F, Sampling(rings, sources, targets, crossings), seed=seed)


def sample_distances(
    V: FloatArray,
    F: IntArray,
    sampling: Sampling,
    *,
    seed: int = 0,
    among: IntArray | None = None,
    lowest: float = 0.0,
) -> SurfaceDistances:
    """Sample distances as `surface_distances` does, without checking the arguments.

    Pairs are formed from the vertices ``among`` (m,), ascending; by default from all vertices of triangles. ``lowest``
    is passed to `straight_segments`.
    """
    # Search radius in mean edge lengths per ring.
    reach = 1.3
    rng = np.random.default_rng(seed)
    used = np.unique(F) if among is None else among
    source = used if sampling.sources >= used.size else np.sort(rng.choice(used, sampling.sources, replace=False))
    source = source[morton_order(V[source])]
    edges = edge_graph(F, len(V))
    row, target = neighbours_within(edges, source, sampling.rings)
    if among is not None:
        own = np.isin(target, among)
        row, target = row[own], target[own]
    if sampling.targets is not None:
        kept = _sample_each_row(row, sampling.targets, rng)
        row, target = row[kept], target[kept]
    segments = straight_segments(V, F, sampling.crossings, lowest=lowest)
    mean_edge = (segments * edges).sum() / edges.nnz
    length = chain_lengths(segments, source, row, target, float(reach * sampling.rings * mean_edge))
    order = np.argsort(source[row], kind="stable")
    return SurfaceDistances(source[row][order], target[order], length[order], replace(sampling, sources=source.size))


def _sample_each_row(row: IntArray, limit: int, rng: np.random.Generator) -> IntArray:
    """Indices of at most ``limit`` random entries of each row; ``row`` is ascending."""
    # Approximate number of pairs that `_sample_each_row` processes at a time.
    pairs_per_chunk = 1 << 20
    key = row + rng.random(row.size)
    kept = []
    begin = 0
    while begin < row.size:
        heartbeat()
        end = int(np.searchsorted(row, row[min(begin + pairs_per_chunk, row.size) - 1], side="right"))
        part = row[begin:end]
        order = np.argsort(key[begin:end])
        rank = np.arange(part.size) - np.searchsorted(part, part)
        kept.append(begin + np.sort(order[rank < limit]))
        begin = end
    return np.concatenate([np.empty(0, dtype=np.int64), *kept])


def _best_scale(ratio: FloatArray) -> float:
    """The factor s that minimises the mean of ``|s · ratio − 1|``; 1 if all ratios are 0."""
    # The derivative jumps by the ratio at s = 1/ratio. So s is a median of these, weighted by the ratios.
    falling = np.sort(ratio)[::-1]
    weight = np.cumsum(falling)
    return float(1 / falling[np.searchsorted(weight, 0.5 * weight[-1])]) if weight[-1] > 0 else 1.0
