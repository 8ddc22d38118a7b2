"""The head of a Ray cluster. Without it Ray ends this process after a minute, and says nothing about the jobs."""

from __future__ import annotations

import socket
import time

from nerfloom.base.errors import LostProcessError

AWAY = 30.0
"""Seconds without a connection until a head counts as lost. Ray itself ends the process after 60 s."""
PATIENCE = 2.0
"""Maximum seconds of a connection."""


class Head:
    """The process that leads a cluster.

    Args:
        address: where it listens, such as 10.0.0.1:6379.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._away_since: float | None = None

    def answers(self) -> bool:
        """Return whether the head accepts a connection now.

        Raises:
            LostProcessError: if it has not accepted any for `AWAY` seconds.
        """
        host, _, port = self.address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()
        except OSError:
            now = time.monotonic()
            self._away_since = now if self._away_since is None else self._away_since
            if now - self._away_since >= AWAY:
                raise LostProcessError(
                    f"the head of the Ray cluster, {self.address}, is lost: no connection for {AWAY:.0f} s. Finished "
                    "jobs are kept, and running ones save; run the same command again on a running cluster, or without "
                    "--ray-address"
                ) from None
            return False
        self._away_since = None
        return True
