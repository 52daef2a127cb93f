"""The subcommands of ``qhm``, one module each with `declare_arguments` and `run`.

The docstring of a module is the help of its command. It has four paragraphs: a title, which the help leaves out, what
the command does, the exit status, and examples.

They build on the modules of `cli`. Start reading in `check`, then `map`.
"""
