"""Handling of Ctrl-C, SIGTERM and SIGHUP: training ends after the current step, other commands at once, after cleanup.

SIGHUP is sent if a terminal is closed or its connection ends. Under `nohup` it stays ignored.
"""

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

HANGUP = signal.SIGHUP if hasattr(signal, "SIGHUP") else None
"""The signal of a closed terminal; None on Windows, which ends the process."""
NUMBERS = (signal.SIGINT, signal.SIGTERM, *(() if HANGUP is None else (HANGUP,)))
NOTED = b"stopping after this step; again to stop at once, without saving\n"
Handler = Callable[[int, FrameType | None], Any]


class Stopped(KeyboardInterrupt):
    """Interruption by the signal `number`: SIGTERM, or Ctrl-C with a `message` for the user."""

    def __init__(self, number: int = signal.SIGINT, message: str = "") -> None:
        super().__init__(message)
        self.number = number


def exit_status(stop: KeyboardInterrupt) -> int:
    """Return the exit status after an interruption `stop`: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP."""
    return 128 + signal_of(stop)


def signal_of(stop: KeyboardInterrupt) -> int:
    """Return the number of the signal that caused the interruption `stop`."""
    return stop.number if isinstance(stop, Stopped) else signal.SIGINT


@contextmanager
def orderly_end() -> Iterator[None]:
    """Make SIGTERM and SIGHUP raise `Stopped` within a `with` block, so that children and unfinished files go."""

    def end(number: int, frame: FrameType | None) -> None:
        _leave_terminal(number)
        if number == HANGUP:  # another may follow, during the cleanup
            signal.signal(number, signal.SIG_IGN)
        raise Stopped(number)

    # Keep SIGTERM ignored if the parent process ignores it.
    numbers = tuple(number for number in NUMBERS[1:] if signal.getsignal(number) != signal.SIG_IGN)
    with handled(numbers, end):
        yield


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Record signals of `NUMBERS` within a `with` block, so that training can end after a step.

    A second one ends it now, except SIGHUP, which the system and the shell may both send.

    Yields:
        The numbers of the signals received so far.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        _leave_terminal(number)
        for other, handler in before.items():
            if other != HANGUP:  # the system and the shell each send one
                signal.signal(other, handler)
        with suppress(OSError, ValueError):  # not by `say`: the signal may have interrupted a print
            os.write(sys.stderr.fileno(), b"" if console.quiet else NOTED)

    with handled(NUMBERS, note) as before:
        yield received


@contextmanager
def handled(numbers: tuple[int, ...], handler: Handler) -> Iterator[dict[int, Any]]:
    """Handle signals within a `with` block.

    Only the main thread receives signals. In other threads, as of a server or a notebook, this does nothing. SIGHUP
    stays ignored if the parent process ignores it.

    Args:
        numbers: the signals' numbers.
        handler: function that is called with the signal's number and the stack frame.

    Yields:
        The previous handlers by signal; they are restored at the end.
    """
    if threading.current_thread() is not threading.main_thread():
        numbers = ()
    numbers = tuple(one for one in numbers if one != HANGUP or signal.getsignal(one) != signal.SIG_IGN)
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
    """Yield an event that the signals of `NUMBERS` set, so that running jobs can save; then raise `Stopped`.

    Raises:
        Stopped: at the end of the block, if there was a signal.
    """
    stopped, signals = threading.Event(), list[int]()

    def record(number: int, frame: FrameType | None) -> None:
        _leave_terminal(number)
        signals.append(number)
        stopped.set()

    with handled(NUMBERS, record):
        yield stopped
    if signals:
        raise Stopped(signals[0], "stopped; run the same command to continue")


def _leave_terminal(number: int) -> None:
    """After SIGHUP, write no more to a terminal that is gone: each message would fail, before anything is saved."""
    if number != HANGUP:
        return
    for stream in (1, 2):
        try:
            os.write(stream, b"")
        except OSError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream)
            os.close(nowhere)
