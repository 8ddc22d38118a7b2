"""The flags of all commands: read by tyro, with one-line errors."""

from __future__ import annotations

import dataclasses
import io
import math
import re
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr
from typing import Any

from nerfloom.base.errors import FlagError, shown

HELP = ("-h", "--help", "--help-all")
"""Flags that ask for help. --help of `ns-train METHOD` shows only the everyday flags, --help-all shows all."""
FRAME = "╭╮╰╯│─"
"""Characters of tyro's boxes and rules, unless the terminal has only ASCII."""
EDGE = re.compile("^[╭│ ][─ ]")
STYLE = re.compile(r"\033\[[\d;]*m")
NAME = re.compile(r" {4}(--[\w.-]+)")
"""A flag in tyro's list of missing or suggested flags."""
PHRASES = (
    (
        r"(--\S+): no type matching (?:\{None\}\|)?(\S+) could be instantiated from \['(.*)'\]",
        r"\1 is '\3'; it must be \2",
    ),
    (r"; it must be INT\b", "; it must be a whole number"),
    (r"; it must be FLOAT\b", "; it must be a number"),
    (r"(--\S+): invalid literal for int\(\) with base 10: ('.*')", r"\1 is \2; it must be a whole number"),
    (r"(--\S+): could not convert string to float: ('.*')", r"\1 is \2; it must be a number"),
    (r"invalid choice ('.*') for argument '(--\S+)'\. Expected one of \((.*)\)", r"\2 is \1; it must be one of \3"),
    (r"Missing value for argument '(?:\(')?(--[\w.-]+).*", r"\1 needs a value"),  # tyro 1.0 writes ('--flag',)
)
"""Pattern of tyro's message about a value -> our message."""


def read_flags(kind: Any, prog: str, arguments: list[str], takes: str = "", **options: Any) -> Any:
    """Read settings from the arguments of a command.

    Args:
        kind: the class of the settings, or several joined by `|`.
        prog: the command for its help, such as "ns-render orbit".
        arguments: the arguments after `prog`.
        takes: positional arguments for the help, such as "RUN_FOLDER".
        options: further arguments of `tyro.cli`. Without `config`, boolean flags take a value.

    Raises:
        FlagError: if a flag is unknown, missing, or has an invalid value.
        SystemExit: with status 0 after the help.
    """
    import tyro

    from nerfloom.cli.flag_help import RefusedSettings, plain_flags

    arguments = ["--help" if argument in HELP else argument for argument in arguments]
    options = {"config": (tyro.conf.FlagConversionOff,), "registry": plain_flags(), **options}
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            settings = tyro.cli(kind, prog=f"{prog} {takes}".rstrip(), args=arguments, **options)
    except SystemExit as end:
        if not end.code:
            raise
        raise FlagError(in_one_line(said.getvalue(), prog)) from None
    except RefusedSettings as error:
        raise FlagError(str(error)) from error
    sys.stderr.write(said.getvalue())
    return settings


def words_of(settings: Any, kind: type[Any]) -> list[str]:
    """Return words for `read_flags` that give all values of `settings` other than the defaults.

    Args:
        settings: a dataclass with values that are one word each: texts, numbers, paths and truth values.
        kind: `settings`' class, or a base class, for the values of the base class alone.
    """
    values = [(field, getattr(settings, field.name)) for field in dataclasses.fields(kind)]
    return [f"--{field.name.replace('_', '-')}={value}" for field, value in values if value != field.default]


def numbers_in(text: str, count: int, name: str, what: str) -> list[float]:
    """Return the numbers in a word, which commas separate.

    Raises:
        FlagError: if `text` does not have `count` finite numbers: the value `name` must be `what`.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise FlagError(f"{name} is {shown(text)}; it must be {what}")
    return found


def in_one_line(box: str, prog: str) -> str:
    """Return tyro's error box `box` as one line: the fault, and a reference to the help of `prog`."""
    title, *sections = _sections(box)
    what = " ".join(" ".join(sections[0] if sections else title).split()).removeprefix("Error parsing ")
    if what.startswith("Unrecognized options: "):
        what = _unknown(what.partition(": ")[2].split(", "))
        names = [name for section in sections[1:] for name in _names(section)]
        what += f". Did you mean {' or '.join(map(repr, dict.fromkeys(names)))}?" if names else ";"
    else:
        if missing := _names(sections[0]) if sections and "Required options" in title[0] else []:
            unknown = [row.strip() for rows in sections[1:] if rows[0].startswith("Unrecognized") for row in rows[1:]]
            what = f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
            what += f", and there is an {_unknown(unknown)}" if unknown else ""
        for pattern, replacement in PHRASES:
            what = re.sub(pattern, replacement, what)
        what = what.rstrip(".") + ";"
    return f"{what} {prog} --help shows the flags"


def _unknown(words: list[str]) -> str:
    """Return a message about unknown words; some may be values of an unknown flag."""
    flags = [word for word in words if word.startswith("-")]
    return f"unknown flag {', '.join(flags)}" if flags else f"unexpected argument {', '.join(map(repr, words))}"


def _names(rows: list[str]) -> list[str]:
    """Return the flags that a section lists."""
    return [found[1] for row in rows if (found := NAME.match(row))]


def _sections(box: str) -> Iterator[list[str]]:
    """Yield the rows of the title and of each section, without the frame."""
    rows: list[str] = []
    for line in STYLE.sub("", box).splitlines():
        row = EDGE.sub("", line).rstrip(f" {FRAME}")
        if row.strip(" -"):
            rows.append(row)
        if rows and (line.startswith("╭") or not row.strip(" -")):  # below the title, and at a rule
            yield rows
            rows = []
    if rows:
        yield rows
