"""Read text and numbers from untrusted files, and write files completely or not at all.

The package uses NumPy only. Start reading in `textual`, then `atomic`.
"""
