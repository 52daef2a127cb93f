"""What a page does with its surface: open it, choose the boundary, drag vertices, compute the final map, save it.

The package builds on `solver` and `apps`. Start reading in `session`, then `setup` and `drag`.
"""
