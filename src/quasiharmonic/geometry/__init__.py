"""Triangle meshes, exact predicates, the certificate, plane curves, coarsening and example surfaces.

The package builds on `util`. Start reading in `mesh.topology` for meshes, and in `exact.certificate` for the test
whether a map is injective.
"""
