"""The contents of a model's file: mesh, map with seams, materials and textures.

The package builds on `geometry.mesh` and `SeamedMesh`. Start reading in `meshdata`.
"""
