"""Shared helpers of the tests: meshes and problems, exact references, sample files, failures. It contains no test."""
