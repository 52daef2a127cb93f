"""Errors of factorisations and solves."""

from __future__ import annotations


class NotPositiveDefinite(ArithmeticError):  # noqa: N818  (the name says what happened to the matrix, not to the program)
    """Raised if a matrix is not numerically positive definite, or if no solution is accurate enough.

    Callers are expected to handle it with a shorter step, an addition to the diagonal, or another backend.
    """
