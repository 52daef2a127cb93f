"""A map of a refined mesh onto any simple target.

The proof that there is one is a way to make it (the page of the documents on it has it in full):

    target ──regions──▶ convex polygons, and cuts between them ─┐
    mesh ──sheet──▶ copies of vertices on either side of a cut ─┴─cutting, walks──▶ disks, one for each polygon
         ──sides──▶ no edge along a straight side ──embedding──▶ Tutte's map of each ──▶ certified
         ──thinning, opening──▶ as few vertices added as the map can do with

Exact arithmetic would need no more. What rounding inverts is embedded in other ways, and else named.

The package builds on `solver.methods`. Start reading in `constructing`.
"""
