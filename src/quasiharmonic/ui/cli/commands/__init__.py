"""The subcommands of ``qhm``, one module each with `add_parser` and `run`.

They build on the modules of `cli`. Start reading in `check`, then `map`.
"""
