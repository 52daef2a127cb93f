"""Motion of simulation meshes with their boundary: elements of three, four and six nodes.

The package builds on `energies` and `solver`. Start reading in `morphing`, then `moving_mesh` for many steps.
"""
