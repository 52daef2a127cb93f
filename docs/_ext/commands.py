"""The page of the command line, generated from the parsers of ``qhm``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from quasiharmonic.ui import cli

HEAD = """# The command `qhm`

This page lists the commands, their options and their exit statuses. Look up here which command takes
an option, and what it does there.

```text
qhm COMMAND …
qhm COMMAND --help
```

## Exit status

| status | meaning |
|---|---|
| 0 | The request succeeded, and a written map is certified injective. |
| 1 | A map was written or checked, and it is not injective. |
| 2 | The input or the call is wrong, or an interrupted command has no map yet. Nothing was written. |
| 3 | A map was written, but its report failed. |
"""


def _commands() -> dict[str, argparse.ArgumentParser]:
    """Return the parser of every command, in the order of the help."""
    parser = cli.parser_of(cli.COMMANDS)
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(commands.choices)


def _options(commands: dict[str, argparse.ArgumentParser]) -> dict[str, list[str]]:
    """Return the commands that take each option, by its longest form; the option of most commands first."""
    takers: dict[str, list[str]] = {}
    for name, parser in commands.items():
        for action in parser._actions:
            if action.option_strings and action.dest != "help":
                takers.setdefault(", ".join(sorted(action.option_strings, key=len)), []).append(name)
    return dict(sorted(takers.items(), key=lambda item: (-len(item[1]), item[0].lstrip("-"))))


def _page() -> str:
    """Return the page in Markdown."""
    commands = _commands()
    lines = [HEAD, "## Commands", ""]
    for title, group in cli.GROUPS.items():
        lines += [f"{title[0].upper()}{title[1:]}:", "", "| command | what it does |", "|---|---|"]
        lines += [f"| [`{name}`](#qhm-{name}) | {text} |" for name, text in group.items()] + [""]
    takers = _options(commands)
    lines += ["## Which command takes which option", "", "Options of several commands:", ""]
    lines += ["| option | commands |", "|---|---|"]
    lines += [
        f"| `{option}` | {', '.join(f'`{name}`' for name in names)} |"
        for option, names in takers.items()
        if len(names) > 1
    ]
    lines += ["", "Options of one command:", "", "| command | options |", "|---|---|"]
    for name in commands:
        own = [f"`{option}`" for option, names in takers.items() if names == [name]]
        lines += [f"| `{name}` | {', '.join(own)} |"] if own else []
    for name, command in commands.items():
        lines += ["", f"## qhm {name}", "", "```text", command.format_help().rstrip(), "```"]
    return "\n".join(lines) + "\n"


def _write(app: Sphinx) -> None:
    """Write the page into the folder of the reference."""
    os.environ["COLUMNS"] = "100"
    Path(app.srcdir, "reference", "command.md").write_text(_page(), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
