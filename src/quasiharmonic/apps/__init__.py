"""What people do with maps, one package each: free boundaries, seams, inverses, repair, warping, simulation meshes,
animation, displacement fields, derivatives, layers for PyTorch and JAX.

The packages build on `solver` and `energies`. Start reading in `flattening.flattened` for `flatten`.
"""
