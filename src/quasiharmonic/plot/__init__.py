"""Pictures of surfaces and maps, drawn with matplotlib but without its global state or a display."""

from quasiharmonic.plot.maps import plot_before_after, plot_map, plot_surface, save_map_figure

__all__ = ["plot_before_after", "plot_map", "plot_surface", "save_map_figure"]
