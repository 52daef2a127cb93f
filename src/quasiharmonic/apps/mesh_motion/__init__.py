"""Meshes that follow their boundary: simulation meshes with elements of three, four and six nodes, and animations.

The package builds on `energies` and `solver`. Start reading in `morphing`, then `moving_mesh` for many steps, and in
`frame_sequence` for animations.
"""
