"""What callers hand over in place of arrays: mesh objects of any library, and files."""
