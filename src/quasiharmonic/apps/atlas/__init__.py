"""Maps with seams: the library's functions, applied to each island.

Every function takes a `SeamedMesh` in place of ``V, F, uv`` and has the name of the function for one surface. The
package builds on `apps.flattening` and `solver`. Start reading in `island_functions`.
"""
