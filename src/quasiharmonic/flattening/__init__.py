"""Flat maps whose boundary goes where it likes, and what holds it or keeps it from overlapping itself."""
