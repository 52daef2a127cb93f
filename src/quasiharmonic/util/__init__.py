"""Array checks, progress reports, display of results, and compiled loops.

The package imports nothing else of the library. Everything above builds on it. Start reading in `arrays`, which checks
what callers pass.
"""
