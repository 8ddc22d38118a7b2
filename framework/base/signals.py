"""Handling of Ctrl-C and SIGTERM: training ends after the current step, other commands at once, after cleanup."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from nerfloom.base.console import console

NUMBERS = (signal.SIGINT, signal.SIGTERM)
NOTED = b"stopping after this step; again to stop at once, without saving\n"
Handler = Callable[[int, FrameType | None], Any]


class Stopped(KeyboardInterrupt):
    """Interruption by the signal `number`: SIGTERM, or Ctrl-C with a `message` for the user."""

    def __init__(self, number: int = signal.SIGINT, message: str = "") -> None:
        super().__init__(message)
        self.number = number


def exit_status(stop: KeyboardInterrupt) -> int:
    """Return the exit status after an interruption `stop`: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + signal_of(stop)


def signal_of(stop: KeyboardInterrupt) -> int:
    """Return the number of the signal that caused the interruption `stop`."""
    return stop.number if isinstance(stop, Stopped) else signal.SIGINT


@contextmanager
def orderly_end() -> Iterator[None]:
    """Make SIGTERM raise `Stopped` within a `with` block, so that child processes and unfinished files are removed."""

    def end(number: int, frame: FrameType | None) -> None:
        raise Stopped(number)

    # Keep SIGTERM ignored if the parent process ignores it.
    with handled(() if signal.getsignal(signal.SIGTERM) == signal.SIG_IGN else (signal.SIGTERM,), end):
        yield


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Record Ctrl-C and SIGTERM within a `with` block, so that training can end after a step. A second one ends it now.

    Yields:
        The numbers of the signals received so far.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for other, handler in before.items():
            signal.signal(other, handler)
        with suppress(OSError, ValueError):  # not by `say`: the signal may have interrupted a print
            os.write(sys.stderr.fileno(), b"" if console.quiet else NOTED)

    with handled(NUMBERS, note) as before:
        yield received


@contextmanager
def handled(numbers: tuple[int, ...], handler: Handler) -> Iterator[dict[int, Any]]:
    """Handle signals within a `with` block.

    Only the main thread receives signals. In other threads, as of a server or a notebook, this does nothing.

    Args:
        numbers: the signals' numbers.
        handler: function that is called with the signal's number and the stack frame.

    Yields:
        The previous handlers by signal; they are restored at the end.
    """
    if threading.current_thread() is not threading.main_thread():
        numbers = ()
    before: dict[int, Any] = {number: signal.getsignal(number) for number in numbers}
    try:
        for number in numbers:
            signal.signal(number, handler)
        yield before
    finally:
        for number, other in before.items():
            signal.signal(number, other)


@contextmanager
def stoppable() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set, so that running jobs can save; then raise `Stopped`.

    Raises:
        Stopped: at the end of the block, if there was a signal.
    """
    stopped, signals = threading.Event(), list[int]()

    def record(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        stopped.set()

    with handled(NUMBERS, record):
        yield stopped
    if signals:
        raise Stopped(signals[0], "stopped; run the same command to continue")
