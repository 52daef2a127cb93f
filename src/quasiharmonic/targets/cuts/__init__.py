"""Cuts along which a closed or strongly curved surface can be opened and flattened.

The package builds on `geometry.mesh` and `linsolve`. Start reading in `find`.
"""
