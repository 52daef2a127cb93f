"""Repair of existing maps.

The package builds on `solver`, `targets` and `apps.atlas`. Start reading in `uv_repair`.
"""
