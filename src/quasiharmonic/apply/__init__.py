"""What people do with maps."""
