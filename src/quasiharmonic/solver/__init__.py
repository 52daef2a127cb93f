"""The paper's method: search tensor fields for one whose quasi-harmonic map is injective.

`mapping` has the public functions, `field` the tensors and the functionals V₁ to V₄, `methods` the ways to lower them,
`search` the stages, `refinement` the edge splitting if the given mesh has no map, and `construction` the map onto
any simple target. The package builds on `problem`, `linsolve` and `energies`. Start reading in `field.tensor`, then
`field.functionals`, then `search.search`.
"""
