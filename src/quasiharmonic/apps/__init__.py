"""Applications of the solver, one package each: free boundaries, seams, inverses, repair, warping, air meshes, mesh
motion, animation, displacement fields, derivatives, and layers for PyTorch and JAX.

The packages build on `solver` and `energies`. Start reading in `flattening.free_boundary` for `flatten`.
"""
