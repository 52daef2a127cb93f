"""Deformation energies: densities, their integral over a surface, and Newton steps down it."""
