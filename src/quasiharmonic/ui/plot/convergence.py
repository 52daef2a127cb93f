"""Plot the convergence of a search: energy and inverted triangles over iterations."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.problem.result import MapResult, Step
from quasiharmonic.ui.plot.canvas import RED, name_axes, new_figure
from quasiharmonic.util.arrays import check_instance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLORS = ((0.16, 0.38, 0.75), (0.06, 0.55, 0.50), (0.80, 0.50, 0.05), (0.45, 0.35, 0.75))


def plot_convergence(result: MapResult) -> Figure:
    """Draw the energy of a result's history above its number of inverted triangles, over iterations.

    Each run has its own line because runs lower different objectives. A search lowers an energy in excess of the
    target's area; a polish lowers the mean distortion. Values that are not finite or not positive are omitted.

    Parameters
    ----------
    result : MapResult

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        If the result has no history.
    """
    from matplotlib.ticker import MaxNLocator

    check_instance("result", result, MapResult)
    if not result.history:
        raise ValueError("the result has no history to draw")
    figure = new_figure((8, 4.5))
    energy, flips = figure.add_axes((0.09, 0.45, 0.88, 0.5)), figure.add_axes((0.09, 0.12, 0.88, 0.26))
    begin = 0
    for number, (name, steps) in enumerate(_runs(result)):
        at = begin + np.arange(len(steps))
        values = np.array([step.energy for step in steps])
        values[~(np.isfinite(values) & (values > 0))] = np.nan
        color = _COLORS[number % len(_COLORS)]
        energy.plot(at, values, ".-", color=color, markersize=4, linewidth=1.4, label=name)
        flips.plot(at, [step.inverted for step in steps], ".-", color=RED, markersize=4, linewidth=1.2)
        # The next run starts from the last map of this run.
        begin += len(steps) - 1
    if np.isfinite(np.concatenate([line.get_ydata() for line in energy.lines])).any():
        energy.set_yscale("log")
    flips.set_yscale("symlog", linthresh=1)
    flips.set_ylim(0, 2 * max(1, max(step.inverted for step in result.history)))
    for ax, x, y in ((energy, "", "energy"), (flips, "iterations", "inverted")):
        name_axes(ax, x, y)
        ax.set_xlim(0, max(1, begin))
    energy.tick_params(labelbottom=False)
    flips.xaxis.set_major_locator(MaxNLocator(integer=True))
    energy.legend(frameon=False, fontsize=9)
    return figure


def _runs(result: MapResult) -> list[tuple[str, Sequence[Step]]]:
    """Return the runs of the history with the names of their stages; iterations count from 0 in each run."""
    starts = [k for k, step in enumerate(result.history) if k == 0 or step.iteration == 0]
    runs: list[tuple[str, Sequence[Step]]] = []
    stages = list(result.stages)
    for first, last in pairwise([*starts, len(result.history)]):
        names: list[str] = []
        left = last - first - 1
        while stages and (left > 0 or not names):
            left -= stages[0].n_iterations
            names.append(stages.pop(0).name)
        name = names[0] if len(names) == 1 else f"{len(names)} stages, the last {names[-1]}" if names else "run"
        runs.append((name, result.history[first:last]))
    return runs
