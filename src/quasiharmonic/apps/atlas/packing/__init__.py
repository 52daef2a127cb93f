"""Pack charts by shape: arrange maps of pieces of a surface in one or several textures.

The package builds on `geometry.exact`. Start reading in `pack`.
"""
