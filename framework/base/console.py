"""What people see on the terminal: notes on standard error, and progress bars on what takes longer than a second."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from framework.base.errors import printable

T = TypeVar("T")

console = Console(stderr=True, highlight=False)


def say(message: str) -> None:
    """Print a line to the person at the terminal; on standard error, so that output can be piped."""
    console.print(printable(message), markup=False, soft_wrap=True)


def track(items: Iterable[T], title: str, total: int) -> Iterator[T]:
    """Iterate with a progress bar that goes away at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        yield from progress.track(items, total=total, description=title)
