"""Maps with a free boundary that does not overlap itself, also with fixed vertices, and maps that keep distances.

The package builds on `energies` and `solver.methods`. Start reading in `free_boundary`, which calls the steps in order:
initial map, free descent, guarded descent, layout.
"""
