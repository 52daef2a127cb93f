"""Applications of the solver: free boundaries, seams, inverses, repair, warping, baking, air meshes, mesh motion,
animation, displacement fields, derivatives, and layers for PyTorch and JAX.

An application is a module, or a package if it needs more than two.

The packages build on `solver` and `energies`. Start reading in `flattening.free_boundary` for `flatten`.
"""
