"""Mesh formats: OBJ, OFF, PLY, STL, glTF, one reader and one writer each.

The package builds on `io.meshdata`. Start reading in `off`, the shortest one.
"""
