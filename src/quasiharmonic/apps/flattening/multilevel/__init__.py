"""Maps with a free boundary from coarse meshes: a coarse mesh is flattened first, and its map carried to the fine one.

The package builds on `geometry.coarsening` and on the flattening around it. Start reading in `start`.
"""
