"""Charts of the developable pieces of a surface: unrolled, and joined like a paper model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, KEPT_COST, UNDIVIDED_COST, find_hinges
from quasiharmonic.apps.unwrapping.layout import MAX_COMPARED, LayoutChoice
from quasiharmonic.apps.unwrapping.paper_joining import PaperModel
from quasiharmonic.apps.unwrapping.pieces import Pieces, find_pieces
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.splitting import renumber
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, to_points


class JoiningRound(NamedTuple):
    """Limits of the unions of charts in one round of joining, as in `PaperModel.join`."""

    longest: float  # Largest length of a union, in sides of the expected texture
    loss: float  # By which fraction the box of a union may be larger than the boxes of its parts


# The rounds, in this order.
_ROUNDS = (
    JoiningRound(0.25, 0.02),
    JoiningRound(0.45, 0.02),
    JoiningRound(0.8, 0.02),
    JoiningRound(0.8, 0.3),
    JoiningRound(1.2, 1.0),
)
# Limits at which charts are joined only where they must be.
_ONLY_FORCED = JoiningRound(0.0, -1.0)
# Rounds with a larger loss than this are left out if there are more charts than `MAX_COMPARED`: the choice between
# lists of charts would not notice that the union of two charts uses the texture worse.
_SMALL_LOSS = 0.02


def develop_charts(
    V: FloatArray,
    F: IntArray,
    cost: FloatArray,
    choose: LayoutChoice | None,
    check_wanted: Callable[[], object],
    mirror: Mirror | None = None,
) -> tuple[BoolArray, list[Chart]]:
    """Unroll the developable pieces of a surface, and join them to charts without stretch.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    cost : (f, 3) float64
        Factor on the cost of cutting each side of each triangle. Pieces are joined across sides with factors of at
        least `UNDIVIDED_COST` unless they overlap, and never at factors of at most `DEMANDED_COST`. Pieces that cannot
        be joined at a factor of at least `KEPT_COST` count as curved.
    choose : LayoutChoice or None
        How to choose from several lists of charts, whose number decreases; None for the last one.
    check_wanted : callable
        Called now and then; may raise an exception.
    mirror : Mirror, optional
        Mirror images, if seams and charts are to be mirrored.

    Returns
    -------
    developed : (f,) bool
        The triangles of these charts.
    charts : list of Chart
        By rows of ``F``.
    """
    hinges = find_hinges(V, F)
    demanded = hinges.touch(cost <= DEMANDED_COST)
    pieces = find_pieces(V, F, hinges, cost, mirror)
    if not pieces.count:
        return pieces.label >= 0, []
    area, weight = surface_area(V, F), hinges.price(cost)
    model = PaperModel(F, hinges, pieces, area, ~demanded, mirror)
    together = hinges.touch(cost >= UNDIVIDED_COST)
    kept = hinges.touch(cost >= KEPT_COST)
    if kept.any():
        own = replace(pieces, label=pieces.label.copy(), place=pieces.place.copy(), glued=pieces.glued.copy())
        model.join(weight, kept, *_ONLY_FORCED, check_wanted)
        torn = kept & ~pieces.glued
        lost = np.unique(pieces.label[np.concatenate([hinges.first[torn], hinges.second[torn]])])
        if lost[lost >= 0].size:
            pieces = own.without(hinges, np.isin(pieces.label, lost))
            model = PaperModel(F, hinges, pieces, area, ~demanded, mirror)
            model.join(weight, kept, *_ONLY_FORCED, check_wanted)
        if not pieces.count:
            return pieces.label >= 0, []
    known: dict[int, Chart] = {}
    found = [_list_charts(F, model, pieces, known)]
    for longest, loss in _ROUNDS:
        if loss > _SMALL_LOSS and (len(found[-1]) > MAX_COMPARED or (choose is not None and not choose.generous)):
            break
        model.join(weight, together, longest, loss, check_wanted)
        found.append(_list_charts(F, model, pieces, known))
    return pieces.label >= 0, found[-1] if choose is None else choose.choose(found, V, cost)


def _list_charts(F: IntArray, model: PaperModel, pieces: Pieces, known: dict[int, Chart]) -> list[Chart]:
    """Return the joined pieces as charts; ``known`` are those with these labels before."""
    order = np.argsort(pieces.label, kind="stable")
    order = order[pieces.label[order] >= 0]
    charts = []
    for rows in np.split(order, np.flatnonzero(np.diff(pieces.label[order])) + 1):
        label = int(pieces.label[rows[0]])
        # A label keeps its triangles unless more are joined to them.
        if label not in known or len(known[label].triangles) != rows.size:
            own, corner = renumber(model.split(rows), F[rows])
            uv = to_points(pieces.place[rows].ravel()[corner])
            known[label] = Chart(rows, own, F[rows].ravel()[corner], uv, np.ones(rows.size), 0.0)
        charts.append(known[label])
    return charts
