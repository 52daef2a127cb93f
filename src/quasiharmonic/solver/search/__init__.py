"""Run stages one after another until an injective map is found.

The package builds on `solver.methods`. Start reading in `search`, then `stage_run` for the loop and `strategy` for the
lists of stages.
"""
