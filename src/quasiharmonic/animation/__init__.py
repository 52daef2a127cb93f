"""Sequences of targets and of maps: each frame certified, and none that leaps."""
