"""Functions that all commands share: errors on one line, exit statuses, and arguments before the flags."""

from __future__ import annotations

import errno
import os
import platform
import sys
from collections.abc import Callable, Collection, Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import nerfloom
from nerfloom.base.console import console, say
from nerfloom.base.errors import ConfigError, FlagError, LostProcessError, NerfloomError, is_out_of_memory, nearest
from nerfloom.base.from_nerfstudio import KINDS, command_answer
from nerfloom.base.signals import exit_status, orderly_end
from nerfloom.cli.flags import HELP, read_flags
from nerfloom.registry import registered

if TYPE_CHECKING:
    from nerfloom.data.parsed_scene import DataParser

K = TypeVar("K")


def chosen_kind(arguments: list[str], kinds: Mapping[str, K], usage: str, unknown: str) -> tuple[str, K, list[str]]:
    """Look up the first argument, or print the help if there is none or it asks for help.

    Args:
        arguments: arguments of the command.
        kinds: entries by name.
        usage: text of the help.
        unknown: start of the message for an unknown name, such as "unknown path".

    Returns:
        The name, its entry of `kinds` and the remaining arguments.

    Raises:
        ConfigError: if `kinds` has no such name; the message suggests the nearest.
        SystemExit: with status 0 after the help.
    """
    if not arguments or arguments[0] in HELP:
        print(usage)
        sys.exit(0)
    name = arguments[0]
    if name in KINDS and name not in kinds:
        raise ConfigError(f"'{name}' is nerfstudio's; {KINDS[name]}")
    if name not in kinds:
        raise ConfigError(f"{unknown} '{name}'. {nearest(name, list(kinds))}")
    return name, kinds[name], arguments[1:]


def refuse_foreign(arguments: list[str], answers: Mapping[str, str], command: str) -> None:
    """Refuse flags of nerfstudio's `command` in `arguments` that are not here, with `answers` of `from_nerfstudio`.

    Raises:
        FlagError: with the answer to the first such flag.
    """
    if answer := next(filter(None, (command_answer(word, answers, command) for word in arguments)), None):
        raise FlagError(answer)


def with_run(arguments: list[str], several: Collection[str] = (), flag: str = "--load-config") -> list[str]:
    """Insert --load-config before a run's path that lacks it: `ns-eval RUN` becomes `ns-eval --load-config RUN`.

    Args:
        arguments: arguments of the command; each flag has one value, as the next argument or after a "=".
        several: flags that take several words; a path ends them.
        flag: the flag that is inserted.
    """
    if any(word.partition("=")[0] == flag for word in arguments):
        return arguments
    index = 0
    while index < len(arguments):
        word = arguments[index]
        if not word.startswith("-"):
            return [*arguments[:index], flag, *arguments[index:]]
        index += 1 if "=" in word or word in HELP else 2
        while word.replace("_", "-") in several and index < len(arguments) and _is_word(arguments[index]):
            index += 1
    return arguments


def _is_word(argument: str) -> bool:
    """Return whether an argument is neither a flag nor a path; a number such as 0.5 is neither, nor is 0.5,-2."""
    if all(map(_is_number, argument.split(","))):
        return not Path(argument).exists()
    return not argument.startswith("-") and not set("/\\.") & set(argument) and not Path(argument).exists()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def with_format(command: str, arguments: list[str]) -> tuple[list[str], tuple[str, DataParser] | None]:
    """Split the arguments of a command from the data format named after them.

    Flags after the format's name belong to the format if it has them, else to the command.

    Args:
        command: name of the command, for the format's help.
        arguments: arguments of the command, after `with_run`.

    Returns:
        The command's arguments, and the format's name and flags; None if no format is named.
    """
    formats = registered("dataparsers")
    for index, word in enumerate(arguments):
        before = arguments[index - 1] if index else ""
        if word in formats and (not before.startswith("-") or "=" in before):
            break
    else:
        return arguments, None
    from nerfloom.registry import load_dataparser

    found: Any = read_flags(
        load_dataparser(word), f"{command} {word}", arguments[index + 1 :], return_unknown_args=True
    )
    parser, others = found
    return arguments[:index] + others, (word, parser)


def take(arguments: list[str], flag: str) -> tuple[str | None, list[str]]:
    """Take a `flag` and its value, the next word or the rest after a "=", out of the `arguments` of a command.

    Returns:
        The value, None if the flag is not given, and the other arguments.

    Raises:
        FlagError: if the value is missing.
    """
    for index, argument in enumerate(arguments):
        if argument == flag:
            if index + 1 == len(arguments):
                raise FlagError(f"{flag} needs a value")
            return arguments[index + 1], arguments[:index] + arguments[index + 2 :]
        if argument.startswith(flag + "="):
            return argument[len(flag) + 1 :], arguments[:index] + arguments[index + 1 :]
    return None, arguments


def make_room(path: Path) -> None:
    """Create the folder of the file `path`, and check that the file can be written, before any work.

    Raises:
        ConfigError: if it cannot be written.
    """
    existed = os.path.lexists(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
        if not existed:
            path.unlink()
    except OSError as error:
        # If the folder is a file, `mkdir` only reports that it exists.
        reason = os.strerror(errno.ENOTDIR) if isinstance(error, FileExistsError) else error.strerror
        raise ConfigError(f"cannot write {path}: {reason}; name another place") from error


def check_weights(path: Path | None) -> None:
    """Check a file of LPIPS weights, if `path` is not None, before any work.

    Raises:
        ConfigError: if it cannot be used.
    """
    if path is not None:
        from nerfloom.evaluation.lpips import read_weights

        read_weights(path)


def entry_point(command: Callable[[list[str]], None]) -> Callable[[], None]:
    """Return the entry point of a `command`, a function of its arguments, as `run_command` runs it."""
    return wraps(command)(lambda: run_command(command))


def run_command(command: Callable[[list[str]], None]) -> None:
    """Run a `command` on the arguments of the process, without `--debug`, and exit with its status.

    Errors that a user can act on are printed on one line; the exit status is 1, or 2 for an error in the flags. The
    argument `--debug` shows the traceback. After a signal the status is 128 plus the signal's number. `--version`
    prints the version, and with `--environment` also the details for error reports.
    """
    arguments = [_from_home(argument) for argument in sys.argv[1:] if argument != "--debug"]
    debug = len(arguments) < len(sys.argv) - 1
    if "--version" in (*arguments[:1], *arguments[-1:]):
        print(_environment() if "--environment" in arguments else version())
        return
    try:
        with orderly_end():
            command(arguments)
    except BrokenPipeError:
        sys.exit(1)
    except (NerfloomError, OSError) as error:
        if debug:
            raise
        console.quiet = False  # every process says why it ends
        say(f"error: {in_our_words(error)}")
        if isinstance(error, LostProcessError):  # threads that wait for the lost process can abort Python's shutdown
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(1)
        sys.exit(2 if isinstance(error, FlagError) else 1)
    except (MemoryError, RuntimeError) as error:
        if debug or not is_out_of_memory(error):
            raise
        console.quiet = False
        say("error: out of memory; reduce settings such as --num-rays-per-batch")
        sys.exit(1)
    except KeyboardInterrupt as stop:
        say(str(stop) or "interrupted")
        sys.exit(exit_status(stop))


def _from_home(argument: str) -> str:
    """Return an argument with the home folder for "~" at the beginning of a value: most shells leave --data=~/x."""
    flag, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    return f"{flag}{equals}{os.path.expanduser(value)}"


def version() -> str:
    """Return the line that --version prints: the package's version, its folder, and the version of Python."""
    folder = Path(nerfloom.__file__).parent
    return f"nerfloom {nerfloom.__version__} from {folder} (Python {platform.python_version()})"


def _environment() -> str:
    from nerfloom.cli.environment import environment  # loads torch, which --version alone does not need

    return environment()


def in_our_words(error: Exception) -> str:
    """Return the message of an `error` on one line; for an OSError its file and reason, without the number."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    return str(error)
