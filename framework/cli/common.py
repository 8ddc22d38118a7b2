"""What the commands share: one-line errors, and how flags become settings."""

from __future__ import annotations

import sys
from collections.abc import Callable

from framework.console import say
from framework.errors import NerfloomError


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
    except KeyboardInterrupt:
        say("interrupted")
        sys.exit(130)
