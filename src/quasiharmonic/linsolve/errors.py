"""What a factorisation or a solve may end in."""

from __future__ import annotations


class NotPositiveDefinite(ArithmeticError):  # noqa: N818  (the name says what happened to the matrix, not to the program)
    """The matrix is not numerically positive definite, or no solution can be vouched for.

    Callers are expected to handle it: by a shorter step, by adding to the diagonal, by another backend.
    """
