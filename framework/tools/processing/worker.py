"""Work in a process of its own: COLMAP prints to a log, a crash in it is an error in one line, it ends when we do."""

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

from framework.base.console import track
from framework.base.errors import DataError, NerfloomError

Report = Callable[[int], None]
"""Told by the work how many units are done."""


def run_apart(
    work: Callable[..., Any],
    arguments: tuple,
    title: str,
    total: int,
    log: Path | None,
    count: Callable[[], int] | None = None,
) -> Any:
    """`work(report, *arguments)` in another process, with a progress bar.

    Args:
        work: a function of a module, and arguments and result, that can be pickled.
        total: units of the progress bar.
        log: file that all it prints is added to; None leaves it on the terminal.
        count: units done, asked now and then, where the work itself cannot tell.
    Returns: what `work` returns.
    Raises: DataError where the process dies; whatever error the work raises.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(work, arguments, sender, log), daemon=True)
    process.start()
    sender.close()
    outcome: list[Any] = []
    try:
        for _ in track(_units(receiver, process.is_alive, count, total, outcome), title, total=total):
            pass
        process.join()
    finally:
        if process.is_alive():
            process.kill()
            process.join()
        receiver.close()
    if not outcome:
        raise DataError(f"COLMAP stopped while {title.lower()} (exit status {process.exitcode}){_last_words(log)}")
    kind, result = outcome[0]
    if kind == "error":
        raise result
    return result


def _units(
    receiver: Connection,
    alive: Callable[[], bool],
    count: Callable[[], int] | None,
    total: int,
    outcome: list[Any],
) -> Iterator[int]:
    """One item for each unit done, until the process ends; its last message is added to `outcome`."""
    given, done = 0, 0
    while True:
        try:
            if receiver.poll(0.3):
                kind, value = receiver.recv()
                if kind != "at":
                    outcome.append((kind, value))
                    return
                done = max(done, value)
            elif not alive():
                return
        except EOFError:
            return
        if count is not None:
            done = max(done, count())
        for _ in range(given, min(done, total)):
            yield given
            given += 1


def _child(work: Callable[..., Any], arguments: tuple, sender: Connection, log: Path | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # C++ would go on for minutes before Python saw a KeyboardInterrupt
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
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


def _end_with_the_parent() -> None:
    """A parent that is killed can stop nothing. COLMAP lets go of Python's lock while it works."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _last_words(log: Path | None) -> str:
    """The last line of a log, and where it is."""
    if log is None or not log.is_file():
        return ""
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    last = lines[-1].strip()[:200] if lines else "nothing"
    return f"; it said: {last} (all of it: {log})"
