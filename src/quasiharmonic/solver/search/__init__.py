"""Run stages one after another until an injective map is found: `solve`, `injective_maps`, `harmonise`.

The package builds on `solver.methods`. Start reading in `stages`, then `strategy` for the lists of stages.
"""
