"""Maps for problems that the given mesh does not allow: edges are split until a map exists.

The package builds on `solver.search` and `solver.construction`. Start reading in `attempts`.
"""
