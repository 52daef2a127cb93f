"""Read and write files of finite-element meshes: Gmsh, legacy VTK, VTU.

The package builds on `geometry.mesh.elements` and `io.atomic`. Start reading in `files`.
"""
