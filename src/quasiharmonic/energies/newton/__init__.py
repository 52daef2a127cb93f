"""Projected Newton descent of a distortion energy, with its line search and its variants.

The package builds on the energies of the parent package. Start reading in `newton_descent`; `newton_system` assembles
the linear system of each step.
"""
