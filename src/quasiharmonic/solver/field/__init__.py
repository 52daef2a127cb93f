"""Tensor fields: from one complex number per triangle to tensors, to the map, to the functionals.

The package builds on `problem` and `linsolve`. Start reading in `tensor`, then `objective` for one evaluation and
`functionals` for V₁ to V₄.
"""
