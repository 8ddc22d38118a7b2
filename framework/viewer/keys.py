"""Keys of the page, besides the keys that move the camera. Ctrl-K lists all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import viser


class Key(NamedTuple):
    """A key, and its action."""

    key: str
    """Upper-case letter other than W, A, S, D, Q and E, which move the camera."""
    label: str
    """Name of the action."""
    action: Callable[[], object]
    """The action."""


def add_keys(client: viser.ClientHandle, keys: Iterable[Key]) -> None:
    """Make `keys` known to the browser `client`."""
    for key in keys:
        client.gui.add_command(key.label, hotkey=key.key).on_trigger(lambda _, action=key.action: action())
