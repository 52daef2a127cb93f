"""The page ``qhm studio``: a surface beside its map, to be taken hold of."""
