"""Draw figures of surfaces and maps with matplotlib, without its global state and without a display.

The package builds on `geometry` and `problem`. Start reading in `canvas`, then `maps`.
"""

from quasiharmonic.ui.plot.animation import plot_convergence, save_animation, save_figures
from quasiharmonic.ui.plot.maps import (
    plot_before_after,
    plot_map,
    plot_problem,
    plot_surface,
    save_boundary_figure,
    save_map_figure,
)
from quasiharmonic.ui.plot.measures import plot_distortion, plot_field, save_distortion_figure
from quasiharmonic.ui.plot.texture import plot_texture, plot_unwrap, save_texture_figure

__all__ = [
    "plot_before_after",
    "plot_convergence",
    "plot_distortion",
    "plot_field",
    "plot_map",
    "plot_problem",
    "plot_surface",
    "plot_texture",
    "plot_unwrap",
    "save_animation",
    "save_boundary_figure",
    "save_distortion_figure",
    "save_figures",
    "save_map_figure",
    "save_texture_figure",
]
