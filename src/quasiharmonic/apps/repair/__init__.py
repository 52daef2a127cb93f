"""Repair of existing maps, cutting along edges, and fitting an island to an outline.

The package builds on `solver`, `targets` and `apps.atlas`. Start reading in `repairing`.
"""
