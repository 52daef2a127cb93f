"""The mesh: how its triangles are joined, their reference shapes, the operators of §6.2."""
