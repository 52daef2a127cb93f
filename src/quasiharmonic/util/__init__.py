"""Array checks, progress reports, display of results, and compiled loops.

The package imports no other package of the library. All other packages build on it. Start reading in `arrays`, which
checks the arguments of callers.
"""
