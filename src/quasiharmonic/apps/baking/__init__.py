"""The look of a model, baked into textures for new texture coordinates.

The package builds on `io` and `geometry.mesh`. Start reading in `bake`.
"""
