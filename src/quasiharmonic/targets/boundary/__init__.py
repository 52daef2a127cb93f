"""Correspondence of boundary vertices to positions on an outline.

The package builds on the outlines and on `problem`. Start reading in `boundary_to`, then `correspondence`.
"""
