"""Whatever is decided exactly: orientations, outlines, verdicts, where a point lies, what forbids a map."""
