"""Run stages one after another until an injective map is found.

The package builds on `solver.methods`. Start reading in `search`, then `record` for the loop and `stages` for the lists
of stages.
"""
