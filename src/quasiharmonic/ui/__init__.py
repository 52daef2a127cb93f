"""User interfaces: figures, the command line, batch runs over data sets, reports and the browser application.

These packages build on all other packages. Start reading in `cli` for the command, and in `plot` for figures.
"""
