"""A map of the mesh as it is, or else of one to which as few vertices as need be were added."""
