"""Elastic shapes that move past obstacles without overlaps.

The package builds on `energies` and on a triangulation of the space between the shapes. Start reading in `airmesh`.
"""
