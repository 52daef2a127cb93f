"""Elastic shapes that move past obstacles without an overlap.

The package builds on `energies` and on a triangulation of the space between the shapes. Start reading in `airmesh`.
"""
