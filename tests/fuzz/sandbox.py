"""Forbidden actions of reading: recorded by Python's audit hooks (PEP 578), and prevented by limits."""

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
FORBIDDEN = frozenset(
    {
        "ftplib.connect", "http.client.connect", "os.exec", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn",
        "os.startfile", "os.system", "pickle.find_class", "pty.spawn", "socket.bind", "socket.connect",
        "socket.getaddrinfo", "subprocess.Popen", "urllib.Request", "webbrowser.open",
    }
)  # fmt: skip
"""Events that no reader of data has a reason for."""
CHANGING = frozenset(
    {"os.chmod", "os.chown", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.symlink", "shutil.rmtree"}
)
"""Events that change files, their arguments being paths, and more; the last a folder's number that they start from."""


class Watch:
    """Records forbidden actions anywhere in this process, for good, as such hooks cannot be removed.

    Args:
        allowed: folders that may be written below.
    """

    def __init__(self, allowed: Sequence[Path]) -> None:
        self.allowed = [str(folder.resolve()) for folder in allowed]
        self.notes: list[str] = []
        self._watching = False
        sys.addaudithook(self._note)

    @contextmanager
    def watching(self) -> Iterator[list[str]]:
        """Yields the list that notes are added to while the block runs."""
        self.notes.clear()
        self._watching = True
        try:
            yield self.notes
        finally:
            self._watching = False

    def _note(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._watching:
            return
        if event in FORBIDDEN:
            self.notes.append(f"{event} {arguments!r:.200}")
        elif event == "open":
            path, _, flags = arguments
            if isinstance(flags, int) and flags & WRITING and not self._may_change(path):
                self.notes.append(f"wrote {path!r:.200}")
        elif event in CHANGING and not (isinstance(arguments[-1], int) and arguments[-1] >= 0):
            self.notes += [f"{event} {path!r:.200}" for path in arguments[:2] if not self._may_change(path)]

    def _may_change(self, path: Any) -> bool:
        """Whether a path is allowed, or is none: a file that is open already, a mode."""
        if not isinstance(path, (str, bytes, os.PathLike)) or os.fspath(path) in ("/dev/null", b"/dev/null"):
            return True
        try:
            place = os.path.realpath(os.fsdecode(path))
        except ValueError:  # a name that no file can have
            return True
        return any(place == folder or place.startswith(folder + os.sep) for folder in self.allowed)


def limit_memory(more: int) -> None:
    """Limit the further address space of this process to a number of bytes, where the system reports its present
    size."""
    import resource

    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (OSError, ValueError):
        return
    limit = pages * resource.getpagesize() + more
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def limit_files(size: int) -> None:
    """Limit the size of files to a number of bytes, and let a crash leave no file."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Let the system end this process where the block takes longer: no loop, and no other language, holds that up."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
