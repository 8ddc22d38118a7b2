"""Output on the terminal: messages on standard error, and progress bars for operations longer than a second."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from framework.base.errors import printable

T = TypeVar("T")

console = Console(stderr=True, highlight=False)


def say(message: str) -> None:
    """Print a line to standard error, so that standard output can be piped.

    Args:
        message: plain text; it is not parsed as rich markup.
    """
    console.print(printable(message), markup=False, soft_wrap=True)


def track(items: Iterable[T], title: str, total: int) -> Iterator[T]:
    """Iterate over `items` with a progress bar that disappears at the end.

    Args:
        items: any iterable.
        title: text in front of the bar.
        total: number of items.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        yield from progress.track(items, total=total, description=title)


@contextmanager
def track_bytes(title: str, total: int | None, done: int = 0) -> Iterator[Callable[[int], None]]:
    """Show a progress bar in bytes within a `with` block, on a terminal.

    Args:
        title: text in front of the bar.
        total: number of bytes in the end; None if it is unknown.
        done: number of bytes that are there already.

    Yields:
        Function that is called with the number of further bytes.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    shown = Progress(*columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal)
    with shown as progress:
        task = progress.add_task(title, total=total, completed=done)
        yield lambda count: progress.advance(task, count)
