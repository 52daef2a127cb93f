"""The subcommands of ``qhm``, one module each with `add_parser` and `run`.

They build on the modules beside this package. Start reading in `check`, then `map`.
"""
