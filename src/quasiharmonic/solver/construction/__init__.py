"""Construction of a map of a refined mesh onto any simple target.

The proof that such a map exists is constructive (the documentation has a page with the full proof):

    target ──regions──▶ convex polygons, and cuts between them ─┐
    mesh ──sheet──▶ copies of vertices on either side of a cut ─┴─cutting, walks──▶ disks, one for each polygon
         ──sides──▶ no edge along a straight side ──embedding──▶ Tutte's map of each ──▶ certified
         ──thinning, opening──▶ as few added vertices as possible

If a map has few inverted triangles, this is done only in patches around them.

In exact arithmetic this would suffice. Pieces that rounding inverts are embedded in other ways; if that fails, their
triangles are reported.

The package builds on `solver.methods`. Start reading in `constructing`.
"""
