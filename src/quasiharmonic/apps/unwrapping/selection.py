"""Parts of a cleaned mesh, such as the triangles to unwrap, and the charts of the other triangles, which stay."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.unwrapping.chart_verdict import UnwrapCertificate, certify_charts
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh
from quasiharmonic.apps.unwrapping.layout import ChartLayout, find_differing_sides
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.mesh.reference import area_vectors
from quasiharmonic.geometry.mesh.splitting import fans, renumber
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_range,
    convert_array,
    find_exponent,
    index_array,
    mark,
    names_of,
    pad_to_space,
    to_complex,
)


def read_faces(faces: ArrayLike, count: int) -> BoolArray:
    """Return a mask (f,) of the triangles that ``faces`` selects by a mask or by numbers."""
    given = convert_array("faces", faces)
    if given.dtype == np.bool_:
        mask = given.copy()
        if mask.shape != (count,):
            raise ValueError(f"faces must be a mask of shape ({count},) or numbers of triangles, not {mask.shape}")
    else:
        chosen = index_array("faces", faces)
        if chosen.ndim != 1:
            raise ValueError(f"faces must have shape (k,), numbers of triangles, not {chosen.shape}")
        check_range("faces", chosen, count, "triangle", "triangles")
        mask = mark(count, chosen)
    if not mask.any():
        raise ValueError("faces selects no triangle: select some, or omit faces to unwrap all")
    return mask


def select(cleaned: CleanedMesh, chosen: BoolArray, apart: IntArray | None = None) -> CleanedMesh:
    """Return the part of a cleaned mesh with the chosen triangles (f,) of the model.

    It is cut between triangles with different numbers ``apart`` (f,). Its vertices are split where the part only
    touches itself. Attributes that refer to the whole model are unchanged.
    """
    rows = np.flatnonzero(chosen[cleaned.triangles])
    if not rows.size:
        raise ValueError("all triangles that faces selects are degenerate or repeated: select others")
    joined = (
        cleaned.F[rows] if apart is None else cleaned.F[rows] + len(cleaned.V) * apart[cleaned.triangles[rows], None]
    )
    F, corner = renumber(fans(joined)[0], cleaned.F[rows])
    origin = cleaned.F[rows].ravel()[corner]
    return replace(
        cleaned,
        V=cleaned.V[origin],
        F=F,
        vertices=cleaned.vertices[origin],
        triangles=cleaned.triangles[rows],
        corners=cleaned.corners[rows],
        flipped=cleaned.flipped[rows],
        widened=cleaned.widened[rows],
        moved=cleaned.moved[origin],
        component=cleaned.component[rows],
    )


@dataclass(frozen=True, eq=False)
class KeptCharts:
    """Charts of a cleaned mesh that stay in the texture.

    Attributes
    ----------
    replaced : (f,) bool
        The triangles of the model that do not stay.
    corner_uv : (f, 3, 2) float64
        Texture coordinates of the model's corners.
    rows : (k,) int64
        Triangles that stay, as rows of the cleaned mesh, ascending.
    layout : ChartLayout
        Their charts. Parts of one chart that are not connected any more count as one.
    before : ChartLayout
        The charts including what is replaced. Its first `count` charts are those of ``layout``, with the same numbers;
        charts that are replaced completely follow.
    triangles : (l,) int64
        Triangles of the model in ``before``.
    """

    replaced: BoolArray
    corner_uv: FloatArray
    rows: IntArray
    layout: ChartLayout
    before: ChartLayout
    triangles: IntArray

    @property
    def count(self) -> int:
        """Number of charts."""
        return int(self.layout.chart.max(initial=-1)) + 1

    @property
    def area(self) -> float:
        """Area of the charts in the texture."""
        return float(np.abs(signed_areas(self.layout.rows, to_complex(self.layout.uv))).sum())

    def find_density(self, V: FloatArray, F: IntArray, size: tuple[int, int]) -> float | None:
        """Return the mean of the texels per unit of length of the model, weighted by area; None if it is zero."""
        exponent = find_exponent(V)
        area = np.linalg.norm(area_vectors(pad_to_space(np.ldexp(V, -exponent)), F[~self.replaced]), axis=1) / 2
        sides = self.corner_uv[~self.replaced] * size
        texels = np.abs(np.linalg.det(sides[:, 1:] - sides[:, :1])) / 2
        total = float(area.sum())
        density = float(np.sqrt(area * texels).sum()) / total if total > 0 else 0.0
        return float(np.ldexp(density, -exponent)) or None

    def join(self, new: ChartLayout, cleaned: CleanedMesh) -> ChartLayout:
        """Return the layout of all charts of a cleaned mesh, new ones first."""
        stay, replaced = self.rows, np.flatnonzero(self.replaced[cleaned.triangles])
        order, kept = np.argsort(np.concatenate([replaced, stay])), self.layout
        return ChartLayout(
            np.concatenate([new.rows, kept.rows + len(new.uv)])[order],
            np.concatenate([new.uv, kept.uv]),
            np.concatenate([new.chart, kept.chart + int(new.chart.max()) + 1])[order],
            np.concatenate([new.mirrored, kept.mirrored])[order],
        )

    def certify(
        self, joined: ChartLayout, cleaned: CleanedMesh, *, size: tuple[int, int], padding: float, stacked: bool
    ) -> UnwrapCertificate:
        """Certify new and kept charts together.

        Parts that stay may touch at a vertex. They are sound if their charts were.
        """
        verify = partial(certify_charts, size=size, padding=padding, stacked=stacked)
        found = verify(joined, cleaned.triangles)
        if found.bijective or not self.count:
            return found
        before = verify(self.before, self.triangles)
        good, new = found.bijective_charts.copy(), len(found.bijective_charts) - self.count
        good[new:] |= before.bijective_charts[: self.count]
        pairs = before.overlapping[(before.overlapping < self.count).all(axis=1)] + new
        pairs = pairs[~found.bijective_charts[pairs].all(axis=1)]
        return replace(
            found, bijective_charts=good, overlapping=np.unique(np.concatenate([found.overlapping, pairs]), axis=0)
        )

    def restore(self, uv: FloatArray, rows: IntArray) -> tuple[FloatArray, IntArray]:
        """Return texture coordinates (m, 2) and their rows (f, 3), with the given coordinates of triangles that stay.

        They stay bit for bit, and so do those of triangles that cleaning excludes.
        """
        bits = self.corner_uv[~self.replaced].reshape(-1, 2).view(np.int64)
        different, number = np.unique(bits, axis=0, return_inverse=True)
        restored = rows.copy()
        restored[~self.replaced] = len(uv) + number.reshape(-1, 3)
        return np.concatenate([uv, different.view(np.float64)]), restored


def keep_charts(cleaned: CleanedMesh, replaced: BoolArray, corner_uv: FloatArray) -> KeptCharts:
    """Return the charts of the triangles that are not replaced (f,), given texture coordinates (f, 3, 2)."""
    missing = np.flatnonzero(~replaced & ~np.isfinite(corner_uv).all(axis=(1, 2)))
    if missing.size:
        raise ValueError(
            f"uv has no texture coordinates for {names_of('triangle', 'triangles', missing)}, which faces does not "
            "select: add them to faces"
        )
    at = cleaned.take_corners(corner_uv)
    there = np.isfinite(at).all(axis=(1, 2))
    F, at = cleaned.F[there], at[there]
    number = np.unique(at.reshape(-1, 2), axis=0, return_inverse=True)[1].reshape(-1, 3)
    cut = mark(F.size, find_differing_sides(F, number, len(cleaned.V))).reshape(-1, 3)
    split, chart = fans(F, cut)
    stays = ~replaced[cleaned.triangles[there]]
    # Charts of which nothing stays are last.
    left = mark(int(chart.max(initial=-1)) + 1, chart[stays])
    chart = np.argsort(np.argsort(~left, kind="stable"))[chart]
    return KeptCharts(
        replaced,
        corner_uv,
        np.flatnonzero(there)[stays],
        _lay_out(fans(F[stays], cut[stays])[0], at[stays], chart[stays]),
        _lay_out(split, at, chart),
        cleaned.triangles[there],
    )


def _lay_out(split: IntArray, at: FloatArray, chart: IntArray) -> ChartLayout:
    """Return the layout of charts with triangles (k, 3), positions (k, 3, 2) and the chart (k,) of each triangle."""
    uv = np.empty((int(split.max(initial=-1)) + 1, 2))
    uv[split] = at
    mirrored: BoolArray = np.bincount(chart, signed_areas(split, to_complex(uv))) < 0
    return ChartLayout(split, uv, chart, mirrored[chart])
