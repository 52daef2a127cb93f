"""Messages of the library in the words of the command line: options in place of keyword arguments."""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from contextvars import ContextVar
from typing import Final

_options: ContextVar[Mapping[str, str] | None] = ContextVar("options", default=None)

_ASSIGNED: Final = re.compile(r"(?<![\w/.-])([a-z_]+)=('[^']*'|[^\s,;:)]+)")
# A name with an underscore, not in a path or a file name.
_NAME: Final = re.compile(r"(?<![\w/.-])[a-z]+(?:_[a-z]+)+(?![\w/-]|\.\w)")
# Names after a verb or a preposition that is followed by nothing else.
_LISTED: Final = re.compile(r"\b(omit|set|by) ((?:[a-z_]+)(?:(?:, (?:and |or )?| and | or )[a-z_]+)*)\b")


def use_options(parser: argparse.ArgumentParser, command: str) -> None:
    """Use the options of a subcommand in the messages from now on."""
    _options.set(list_options(parser, command))


def list_options(parser: argparse.ArgumentParser, command: str) -> dict[str, str]:
    """Return the options of a subcommand by the names of their values."""
    options = {}
    for subcommands in parser._actions:
        if isinstance(subcommands, argparse._SubParsersAction) and command in subcommands.choices:
            for action in subcommands.choices[command]._actions:
                long = [option for option in action.option_strings if option.startswith("--")]
                if long:
                    options[action.dest] = long[0]
    return options


def in_options(text: str) -> str:
    """Return a message with the options of the current subcommand in place of keyword arguments of the same names."""
    options = _options.get()
    if not options:
        return text

    def assigned(found: re.Match[str]) -> str:
        if found[1] not in options:
            return found[0]
        value = found[2].strip("'")
        return options[found[1]] if value in ("True", "False") else f"{options[found[1]]} {value}"

    def listed(found: re.Match[str]) -> str:
        return f"{found[1]} " + re.sub(r"[a-z_]+", lambda name: options.get(name[0], name[0]), found[2])

    text = _LISTED.sub(listed, _ASSIGNED.sub(assigned, text))
    return _NAME.sub(lambda found: options.get(found[0], found[0]), text)
