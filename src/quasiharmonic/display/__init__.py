"""What a notebook shows of a result: words, and a picture."""
