"""Exact tests on coordinates as stored: orientation, crossings, the certificate, point location.

The package builds on `geometry.mesh`. Start reading in `predicates` for the arithmetic, and in `certificate` for the
certificate of a map.
"""
