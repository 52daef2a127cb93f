"""Figures of displayable objects, by type."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
from quasiharmonic.energies.measures import Distortion
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui import plot
from quasiharmonic.ui.plot.canvas import RED, caption, new_figure, verdict
from quasiharmonic.ui.plot.elements import elements_figure
from quasiharmonic.ui.plot.maps import map_figure
from quasiharmonic.util.display import Displayable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("map", "distortion", "texture", "convergence")


def draw(shown: Displayable, kind: str, *, measure: str = "isometric") -> Figure:
    """Draw a result, a morphed mesh, a problem, a certificate, a diagnosis or a distortion measurement.

    ``kind`` is one of `KINDS`, for a `MapResult` only; ``measure`` is that of a distortion. ValueError if the kind is
    unknown, or the object lacks the data to draw.
    """
    match shown:
        case MapResult():
            return _result(shown, kind, measure)
        case MorphResult():
            qualities = shown.quality_before, shown.quality_after
            return elements_figure(shown.F, (shown.points_before, shown.points), qualities, shown.inverted)
        case Distortion():
            return plot.plot_distortion(shown.V, shown.F, shown.uv, measure)
        case Problem():
            return plot.plot_problem(shown.V, shown.F, shown.fixed, shown.target)
        case Certificate():
            return _certificate(shown)
        case Diagnosis():
            return _diagnosis(shown)
    raise TypeError(f"cannot draw a {type(shown).__name__}")


def _result(result: MapResult, kind: str, measure: str) -> Figure:
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if kind == "convergence":
        return plot.plot_convergence(result)
    if result.V is None:
        raise ValueError("the result has no surface: use quasiharmonic.plot with V and F")
    if kind == "distortion":
        return plot.plot_distortion(result.V, result.F, result.uv, measure)
    if kind == "texture":
        return plot.plot_texture(result.V, result.F, result.uv)
    return map_figure(result.V, result.F, result.uv, inverted=_bad(result.certificate))


def _certificate(certificate: Certificate) -> Figure:
    figure = new_figure((4.5, 4.5))
    ax = figure.add_axes((0.01, 0.02, 0.98, 0.88))
    uv, bad = certificate.uv, _bad(certificate)
    plot.plot_map(uv, certificate.F, uv, inverted=bad, ax=ax)
    for i, j, k, m in certificate.crossings.tolist():
        ax.plot(*uv[[i, j]].T, *uv[[k, m]].T, color=RED, linewidth=2.4, zorder=7)
    ax.plot(*uv[certificate.multiply_wound].T, "o", color=RED, markersize=5, zorder=7)
    if not bad.size and certificate.bijective is False:
        caption(ax, "map: not bijective", RED)
    else:
        verdict(ax, "map", len(bad))
    return figure


def _diagnosis(diagnosis: Diagnosis) -> Figure:
    problem = diagnosis.problem
    if problem is None:
        raise ValueError("the diagnosis has no problem to draw")
    # Obstructions of whole loops are not marked, because no part of a loop is the cause.
    vertices = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *(o.vertices for o in diagnosis.obstructions)]))
    triangles = [problem.F[o.triangles][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2) for o in diagnosis.obstructions]
    edges = np.concatenate([np.empty((0, 2), dtype=np.int64), *(o.edges for o in diagnosis.obstructions), *triangles])
    return plot.plot_problem(problem.V, problem.F, problem.fixed, problem.target, vertices=vertices, edges=edges)


def _bad(certificate: Certificate) -> np.ndarray:
    """Return the triangles that are not positive."""
    return np.concatenate([certificate.inverted, certificate.degenerate, certificate.nonfinite])
