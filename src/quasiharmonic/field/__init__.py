"""Tensor fields and the maps that belong to them: ξ, the functionals of it, and their derivatives."""
