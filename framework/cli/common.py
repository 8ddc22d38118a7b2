"""What the commands share: one-line errors, and how flags become settings."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import TypeVar

from framework.console import say
from framework.errors import ConfigError, NerfloomError, is_out_of_memory, nearest

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
    if name not in kinds:
        raise ConfigError(f"{unknown} '{name}'. {nearest(name, list(kinds))}")
    return name, kinds[name], arguments[1:]


def run_command(command: Callable[[list[str]], None]) -> None:
    """Run a command on the process's arguments.

    Errors a user can act on become one line and exit status 1; `--debug` anywhere shows the traceback instead.
    """
    arguments = sys.argv[1:]
    debug = "--debug" in arguments
    try:
        command([argument for argument in arguments if argument != "--debug"])
    except NerfloomError as error:
        if debug:
            raise
        say(f"error: {error}")
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)
    except OSError as error:
        if debug:
            raise
        say(f"error: {error}")
        sys.exit(1)
    except (MemoryError, RuntimeError) as error:
        if debug or not is_out_of_memory(error):
            raise
        say("error: there is not enough memory; smaller settings, such as --num-rays-per-batch, take less")
        sys.exit(1)
    except KeyboardInterrupt:
        say("interrupted")
        sys.exit(130)
