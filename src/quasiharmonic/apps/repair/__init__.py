"""Repair of existing maps, and fitting an island to an outline.

The package builds on `solver`, `targets` and `apps.atlas`. Start reading in `uv_repair`.
"""
