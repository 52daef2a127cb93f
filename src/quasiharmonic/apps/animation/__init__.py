"""Sequences of targets, and their certified maps frame after frame.

The package builds on `solver` and `energies`. Start reading in `animated`.
"""
