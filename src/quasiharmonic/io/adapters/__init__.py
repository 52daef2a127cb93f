"""Accept mesh objects of other libraries, and paths, in place of ``V, F``.

The package builds on `io`. Start reading in `accepts_mesh`, the decorators of public functions, then `objects`.
"""
