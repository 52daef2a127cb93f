"""Distortion energies, distortion measures, and a Newton descent that lowers the energies without inverting triangles.

The package builds on `problem`, `geometry` and `linsolve`. Start reading in `energies` for the densities, then in
`polishing` for `polish`.
"""
