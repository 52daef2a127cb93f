"""Outlines as targets: shapes, letters, words, SVG files, polygons.

The package builds on `geometry.curves`. Start reading in `shapes`.
"""
