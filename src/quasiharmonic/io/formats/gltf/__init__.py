"""Read and write glTF and GLB files; all contents that are not a surface or its map stay unchanged.

The package builds on `io.models`. Start reading in `document`, then `reader` and `writer`.
"""
