"""Where to cut a closed or strongly curved surface so that it can be flattened.

The package builds on `geometry.mesh` and `linsolve`. Start reading in `find`.
"""
