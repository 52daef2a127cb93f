"""Sequences of targets, and a certified map for every frame.

The package builds on `solver` and `energies`. Start reading in `frame_sequence`.
"""
