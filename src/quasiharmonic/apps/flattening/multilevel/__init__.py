"""Free boundaries from coarse meshes: a map of a coarse mesh is found first and carried to the fine one.

The package builds on `geometry.coarsening` and on the flattening around it. Start reading in `start`.
"""
