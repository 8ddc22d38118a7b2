"""Output on the terminal: messages on standard error, and progress bars for operations longer than a second."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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
