"""Functions run in a child process, for COLMAP: output goes to a log, and a crash becomes a one-line error."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from nerfloom.base.console import say, track
from nerfloom.base.errors import DataError, NerfloomError
from nerfloom.base.meter import time_text

Report = Callable[[int], None]
"""Function that the child calls with the number of finished units; with 0 at the beginning, after imports."""
MIN_FINISHED = 4
"""Minimum number of finished units for an estimate of the total time."""
MIN_SECONDS = 1.0
"""Minimum seconds before an estimate of the total time."""
MIN_REPORTED_SECONDS = 10.0
"""Shorter estimates, in seconds, are not reported."""


def run_in_child(
    work: Callable[..., Any],
    arguments: tuple,
    title: str,
    total: int,
    log: Path | None,
    count: Callable[[], int] | None = None,
    unit: str | None = None,
) -> Any:
    """Run `work(report, *arguments)` in a child process, with a progress bar.

    Args:
        work: a module-level function, picklable like its arguments and its result.
        arguments: arguments after `report`.
        title: title of the progress bar.
        total: units of the progress bar.
        log: file for the child's output, appended; None leaves the output on the terminal.
        count: returns the number of finished units, for work that cannot report it.
        unit: name of the units, which take equally long; an estimate of the total time is reported after a few.

    Returns:
        The result of `work`.

    Raises:
        DataError: if the process dies. Errors of `work` are raised unchanged.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(work, arguments, sender, log), daemon=True)
    process.start()
    sender.close()
    outcome: list[Any] = []
    try:
        numbers = _numbers(receiver, process.is_alive, count, outcome)
        for _ in track(_units(_estimated(numbers, title, total, unit) if unit else numbers, total), title, total=total):
            pass
        process.join()
    finally:
        if process.is_alive():
            process.kill()
            process.join()
        receiver.close()
    if not outcome:
        raise DataError(f"COLMAP stopped while {title.lower()} (exit status {process.exitcode}){_last_line(log)}")
    kind, result = outcome[0]
    if kind == "error":
        raise result
    return result


def _numbers(
    receiver: Connection, alive: Callable[[], bool], count: Callable[[], int] | None, outcome: list[Any]
) -> Iterator[int | None]:
    """Yield the number of finished units several times a second, until the process ends; None until it begins.

    The process's last message is appended to `outcome`.
    """
    done: int | None = None
    while True:
        try:
            if receiver.poll(0.3):
                kind, value = receiver.recv()
                if kind != "at":
                    outcome.append((kind, value))
                    return
                done = max(done or 0, value)
            elif not alive():
                return
        except EOFError:
            return
        if count is not None and done is not None:
            done = max(done, count())
        yield done


def _estimated(numbers: Iterator[int | None], title: str, total: int, unit: str) -> Iterator[int | None]:
    """Pass on the numbers of finished units, and report once how long all will take.

    Measurement starts after the first units, which take longer while COLMAP's threads and caches start.
    """
    first: tuple[float, int] | None = None
    said = False
    for done in numbers:
        yield done
        if done and first is None:
            first = time.monotonic(), done
        elif done and first is not None and not said:
            seconds, count = time.monotonic() - first[0], done - first[1]
            if count >= MIN_FINISHED and seconds > MIN_SECONDS:
                said = True
                if seconds / count * total > MIN_REPORTED_SECONDS:
                    say(f"{title}: about {time_text(seconds / count * total)} for {total:,} {unit}")


def _units(numbers: Iterator[int | None], total: int) -> Iterator[int]:
    """Yield once for each finished unit."""
    yielded = 0
    for done in numbers:
        for _ in range(yielded, min(done or 0, total)):
            yield yielded
            yielded += 1


def _child(work: Callable[..., Any], arguments: tuple, sender: Connection, log: Path | None) -> None:
    signal.signal(
        signal.SIGINT, signal.SIG_DFL
    )  # Python handles Ctrl-C only when the C++ function returns, minutes later
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    if log is not None:
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(file, 1)
        os.dup2(file, 2)
    sent = 0.0

    def report(done: int) -> None:
        nonlocal sent
        if time.monotonic() - sent > 0.1:
            sent = time.monotonic()
            sender.send(("at", done))

    try:
        sender.send(("done", work(report, *arguments)))
    except NerfloomError as error:
        sender.send(("error", error))
    except Exception as error:
        first = (str(error).strip().splitlines() or [""])[0]
        sender.send(("error", DataError(f"COLMAP: {type(error).__name__}: {first}")))


def _exit_with_parent() -> None:
    """Exit when the parent process ends, since a killed parent cannot stop its child. COLMAP releases Python's lock."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _last_line(log: Path | None) -> str:
    """Return the last line of a log and the log's path, as the end of a message."""
    if log is None or not log.is_file():
        return ""
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    last = lines[-1].strip()[:200] if lines else "nothing"
    return f"; its last output: {last} (complete: {log})"
