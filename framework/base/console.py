"""Output on the terminal: messages on standard error, and the progress of operations longer than a second.

Progress is a bar on a terminal, and elsewhere, as in a file or under another program, a line every ten seconds.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.filesize import decimal
from rich.progress import BarColumn, Progress, TextColumn

from nerfloom.base.errors import printable
from nerfloom.base.meter import Meter

SECONDS_BETWEEN_LINES = 10.0
"""Seconds between lines of progress where there is no terminal."""

T = TypeVar("T")

console = Console(stderr=True, highlight=False)


def say(message: str) -> None:
    """Print a line to standard error, so that standard output can be piped.

    Args:
        message: plain text; it is not parsed as rich markup.
    """
    console.print(printable(message), markup=False, soft_wrap=True)


def track(items: Iterable[T], title: str, total: int, *, done: int = 0, spent: float | None = None) -> Iterator[T]:
    """Iterate over `items`, and show how far that is and how long it will take.

    Args:
        items: any iterable.
        title: text in front of the bar or in the line.
        total: number of items, with those that are done.
        done: number of items that are done already.
        spent: seconds that those took; None if that is unknown.
    """
    with _shown(Meter(title, total, done, spent), title, total, done) as advance:
        for item in items:
            yield item
            advance(1)


@contextmanager
def track_bytes(title: str, total: int | None, done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show how far an operation on bytes is, and how long it will take, within a `with` block.

    Args:
        title: text in front of the bar or in the line.
        total: number of bytes in the end; None if it is unknown.
        done: number of bytes that are there already.

    Yields:
        Function that is called with the number of further bytes.
    """
    with _shown(Meter(title, total, done, number=decimal), title, total, done) as advance:
        yield advance


@contextmanager
def _shown(meter: Meter, title: str, total: int | None, done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show a meter within a `with` block, and give the function that counts units."""
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
    """Print a meter's line every ten seconds, in a thread: also while one unit takes minutes."""
    ended = threading.Event()

    def print_lines() -> None:
        while not ended.wait(SECONDS_BETWEEN_LINES):
            say(meter.line)

    threading.Thread(target=print_lines, name="progress", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
