"""What the commands share: one-line errors, and how flags become settings."""

from __future__ import annotations

import errno
import os
import platform
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import framework
from framework.base.console import say
from framework.base.errors import ConfigError, NerfloomError, is_out_of_memory, nearest
from framework.base.from_nerfstudio import KINDS
from framework.training.signals import exit_status, orderly_end

K = TypeVar("K")


def chosen_kind(
    arguments: list[str], kinds: Mapping[str, K], usage: str, unknown: str
) -> tuple[str, K, list[str]] | None:
    """What the first argument names, and the arguments behind it; None where help was asked for, which is printed.

    Args:
        kinds: what may be named.
        usage: the help.
        unknown: how to call a name that is not among them, as in "unknown path".
    Raises: ConfigError for such a name, with the nearest.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage)
        return None
    name = arguments[0]
    if name in KINDS and name not in kinds:
        raise ConfigError(f"'{name}' is nerfstudio's; {KINDS[name]}")
    if name not in kinds:
        raise ConfigError(f"{unknown} '{name}'. {nearest(name, list(kinds))}")
    return name, kinds[name], arguments[1:]


def with_run(arguments: list[str]) -> list[str]:
    """The arguments of a command that takes a run, where it may stand without --load-config, as in ns-eval RUN_FOLDER.

    Every flag has one value, or holds it after a =.
    """
    if any(word.partition("=")[0] == "--load-config" for word in arguments):
        return arguments
    place = 0
    while place < len(arguments):
        word = arguments[place]
        if not word.startswith("-"):
            return [*arguments[:place], "--load-config", *arguments[place:]]
        place += 1 if "=" in word or word in ("-h", "--help") else 2
    return arguments


def make_room(path: Path) -> None:
    """Make the folder of a file that is to be written, and see that it can be, before anything is spent on it.

    Raises: ConfigError where it cannot.
    """
    there = os.path.lexists(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
        if not there:
            path.unlink()
    except OSError as error:
        # A file where a folder must be: `mkdir` only says that it exists.
        reason = os.strerror(errno.ENOTDIR) if isinstance(error, FileExistsError) else error.strerror
        raise ConfigError(f"cannot write {path}: {reason}; name another place") from error


def run_command(command: Callable[[list[str]], None]) -> None:
    """Run a command on the process's arguments.

    Errors a user can act on become one line and exit status 1; `--debug` anywhere shows the traceback instead. A
    command that a signal ends says so, and exits with 128 and the signal's number.
    """
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    if "--version" in (*arguments[:1], *arguments[-1:]):
        print(version())
        return
    try:
        with orderly_end():
            command(arguments)
    except BrokenPipeError:
        sys.exit(1)
    except (NerfloomError, OSError) as error:
        if debug:
            raise
        say(f"error: {in_our_words(error)}")
        sys.exit(1)
    except (MemoryError, RuntimeError) as error:
        if debug or not is_out_of_memory(error):
            raise
        say("error: there is not enough memory; smaller settings, such as --num-rays-per-batch, take less")
        sys.exit(1)
    except KeyboardInterrupt as stop:
        say(str(stop) or "interrupted")
        sys.exit(exit_status(stop))


def version() -> str:
    """The line that --version prints: the package's version, where it lies, and the Python that runs it."""
    place = Path(framework.__file__).parent
    return f"nerfloom {framework.__version__} from {place} (Python {platform.python_version()})"


def in_our_words(error: Exception) -> str:
    """An error's line; of the system's errors the file comes first, and its number is left out."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    return str(error)
