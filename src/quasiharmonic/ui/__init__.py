"""Everything that touches a screen, a terminal, a browser or a data set: figures, the command, batches, the page.

The packages build on everything below them. Start reading in `cli` for the command, and in `plot` for figures.
"""
