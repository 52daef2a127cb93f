"""From a problem to a map: what is tried, in which order, and when it ends."""
