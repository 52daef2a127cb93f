"""Mesh formats: OBJ, OFF, PLY, STL and glTF, each with a reader and, except STL, a writer.

The package builds on `io.models`. Start reading in `off`, the shortest one.
"""
