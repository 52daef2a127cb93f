"""Texture coordinates for any model: cleaning, charts under a bound on stretch, packing, and the exact verdict.

The package builds on `apps.flattening`, `apps.atlas` and `targets.cuts`. Start reading in `unwrap`.
"""
