"""Tetrahedral meshes: an exact certificate, valid meshes for a moved boundary, and maps onto a given boundary.

The package builds on `geometry` and `energies`. Start reading in `certificate`, then `placement`
and `tetrahedral_maps`.
"""
