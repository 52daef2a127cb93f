"""Maps of triangle meshes into the plane with no inverted triangle, certified exactly."""
