"""Maps with a free boundary that does not overlap itself.

The package builds on `energies` and `solver.methods`. Start reading in `flattened`, which runs start, free descent,
descent with contacts, and layout one after another.
"""
