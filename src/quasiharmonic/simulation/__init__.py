"""Planar meshes of simulations whose boundary moves: triangles of three and six nodes, and quadrilaterals."""
