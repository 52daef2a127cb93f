"""The construction."""
