"""Projected Newton descent of a distortion energy, with its line search and its variants.

The package builds on the energies beside it. Start reading in `newton_descent`; `newton_system` assembles what each
step solves.
"""
