"""Flat maps that keep distances along the surface: `keep_distances`.

The package builds on `energies.distances` and on the flattening around it. Start reading in `distance_descent`.
"""
