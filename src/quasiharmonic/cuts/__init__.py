"""Where to cut a surface so that it lies flat."""
