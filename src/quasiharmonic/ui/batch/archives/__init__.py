"""Data sets in archives: tar files with the layout of WebDataset, and Parquet files, local or by URL.

An archive contains many problems. Their results are written to one archive, too. Start reading in `archived`, which
streams problems from the archives and results into others; `tar_stream` and `samples` read, `journal` and `results`
write.
"""
