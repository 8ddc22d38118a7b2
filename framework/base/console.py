"""Output on the terminal: messages on standard error, and the progress of long operations.

Progress is a bar on a terminal. Elsewhere, for example in a file, it is a line every ten seconds. If NERFLOOM_PROGRESS
is "often", it is a line every second, also where FORCE_COLOR makes a pipe count as a terminal.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, Progress, TextColumn

from nerfloom.base.errors import printable
from nerfloom.base.meter import Meter

PROGRESS, OFTEN = "NERFLOOM_PROGRESS", "often"
"""Environment variable of the lines of progress, and its value for programs that show them."""
_IS_OFTEN = os.environ.get(PROGRESS) == OFTEN
SECONDS_BETWEEN_LINES = 1.0 if _IS_OFTEN else 10.0
"""Seconds between lines of progress without a terminal."""

T = TypeVar("T")

console = Console(stderr=True, highlight=False, force_terminal=False if _IS_OFTEN else None)


def say(message: str) -> None:
    """Print a line to standard error, so that standard output can be piped. `message` is not parsed as rich markup."""
    console.print(printable(message), markup=False, soft_wrap=True)


def track(items: Iterable[T], title: str, total: int, *, done: int = 0, spent: float | None = None) -> Iterator[T]:
    """Iterate over `items`, and show the progress and the time left.

    Args:
        items: any iterable.
        title: text in front of the bar or in the line.
        total: number of items, including finished ones.
        done: number of items that are already finished.
        spent: seconds that the finished items took; None if unknown.
    """
    with _shown(Meter(title, total, done, spent), title, total, done) as advance:
        for item in items:
            yield item
            advance(1)


@contextmanager
def track_bytes(title: str, total: int | None, done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show the progress of an operation on bytes, and the time left, within a `with` block.

    Args:
        title: text in front of the bar or in the line.
        total: total number of bytes; None if unknown.
        done: number of bytes that are already present.

    Yields:
        Function to call with the number of further bytes.
    """
    with _shown(Meter(title, total, done, number=decimal), title, total, done) as advance:
        yield advance


@contextmanager
def _shown(meter: Meter, title: str, total: int | None, done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show a meter within a `with` block, and yield the function that counts units."""
    if not console.is_terminal:
        with _lines(meter):
            yield meter.advance
        return
    state = TextColumn("{task.fields[meter].state}")
    with Progress(TextColumn("{task.description}"), BarColumn(), state, console=console, transient=True) as progress:
        task = progress.add_task(title, total=total, completed=done, meter=meter)

        def advance(count: int) -> None:
            meter.advance(count)
            progress.advance(task, count)

        yield advance


@contextmanager
def _lines(meter: Meter) -> Iterator[None]:
    """Print a meter's line every ten seconds, from a thread, since one unit may take minutes."""
    ended = threading.Event()

    def print_lines() -> None:
        while not ended.wait(SECONDS_BETWEEN_LINES):
            say(meter.line)

    threading.Thread(target=print_lines, name="progress", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
