"""Ctrl-C and SIGTERM: a run ends between two steps, any other command at once, and in order."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

NUMBERS = (signal.SIGINT, signal.SIGTERM)
NOTED = b"stopping after this step; again to stop at once, without saving\n"
Handler = Callable[[int, FrameType | None], Any]


class Stopped(KeyboardInterrupt):
    """Somebody stops the process: what SIGTERM raises, and Ctrl-C where more is to be said than that.

    Args:
        number: the signal.
        message: what to say of it, where it is not known yet.
    """

    def __init__(self, number: int = signal.SIGINT, message: str = "") -> None:
        super().__init__(message)
        self.number = number


def exit_status(stop: KeyboardInterrupt) -> int:
    """Exit status that a shell expects of a process that a signal ended: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + signal_of(stop)


def signal_of(stop: KeyboardInterrupt) -> int:
    """The signal behind an interruption."""
    return stop.number if isinstance(stop, Stopped) else signal.SIGINT


@contextmanager
def orderly_end() -> Iterator[None]:
    """SIGTERM raises `Stopped`, as Ctrl-C raises KeyboardInterrupt, so that children and unfinished files are removed.

    Only the main thread is told of signals; elsewhere this does nothing.
    """

    def end(number: int, frame: FrameType | None) -> None:
        raise Stopped(number)

    # Where SIGTERM is ignored, whoever started this process wants it so.
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) != signal.SIG_IGN
    with handled((signal.SIGTERM,) if ours else (), end):
        yield


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM end the run after the step at hand; a second one ends it at once.

    Yields the list of signals received.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for other, handler in before.items():
            signal.signal(other, handler)
        with suppress(OSError, ValueError):  # not by `say`: what a signal interrupts may be a line being printed
            os.write(sys.stderr.fileno(), NOTED)

    with handled(NUMBERS, note) as before:
        yield received


@contextmanager
def handled(numbers: tuple[int, ...], handler: Handler) -> Iterator[dict[int, Any]]:
    """Handle signals so; yields how they were handled before, and are again in the end. In the main thread only."""
    before: dict[int, Any] = {number: signal.getsignal(number) for number in numbers}
    try:
        for number in numbers:
            signal.signal(number, handler)
        yield before
    finally:
        for number, other in before.items():
            signal.signal(number, other)
