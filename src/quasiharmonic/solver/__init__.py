"""The paper's method: a search over tensor fields for a quasi-harmonic map that is injective.

`field` has the tensors and the functionals V₁ to V₄, `methods` the ways to lower them, `search` the stages that `solve`
runs, `refine` the splitting of edges where the mesh as given has no map, and `construction` the map onto any simple
target. The package builds on `problem`, `linsolve` and `energies`. Start reading in `field.tensor`, then
`field.functionals`, then `search.stages`.
"""
