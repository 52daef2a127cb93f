"""Distortion energies, their measures, and the Newton descent that lowers them without inverting a triangle.

The package builds on `problem`, `geometry` and `linsolve`. Start reading in `energies` for the densities, then in
`polishing` for `polish`.
"""
