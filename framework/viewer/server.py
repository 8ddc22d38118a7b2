"""The web server of the viewer: its address, and refused connections."""

from __future__ import annotations

import errno
import io
import ipaddress
import logging
import socket
import warnings
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.extras import require

if TYPE_CHECKING:
    import viser

PORTS_TRIED = 100
"""Number of ports tried, starting at the requested one."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Names of the loopback interface, which other machines cannot reach."""
EVERYWHERE = ("0.0.0.0", "::")
"""Hosts that stand for all interfaces of this machine."""


def check_installed() -> None:
    """Raise ConfigError, with the install command, if viser is missing; call it before anything slow."""
    require("viewer", "the viewer needs")


def free_port(host: str, port: int) -> int:
    """Return the first free port of `host`, an interface of this machine, from `port` on.

    Raises:
        ConfigError: if the host is not a local address, or no port is free.
    """
    if not 1 <= port <= 65535:
        raise FlagError(f"--websocket-port is {port}; it must be from 1 to 65535")
    reason = "all are taken"
    for candidate in range(port, min(port + PORTS_TRIED, 65536)):
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                return candidate
        except UnicodeError:
            raise ConfigError(f"--websocket-host {host}: this is not a host name") from None
        except OSError as error:
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                raise ConfigError(f"--websocket-host {host}: {error.strerror or error}") from error
            reason = error.strerror or str(error)
    raise ConfigError(f"--websocket-port {port}: no port from this one on is usable ({reason})")


def open_server(host: str, port: int) -> viser.ViserServer:
    """Start the server on `host` at `port`, or the next free one, and report its address.

    Raises:
        ConfigError: if viser is missing, or the address cannot be used.
    """
    check_installed()
    chosen = free_port(host, port)
    import viser

    _shorten_log()
    # Browsers may leave while a picture is drawn for them.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
    with redirect_stdout(io.StringIO()):  # viser prints a table of addresses
        server = viser.ViserServer(host=host, port=chosen, label="nerfloom", verbose=False)
    _refuse(server, is_local=is_loopback(host))
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    bound = server.get_port()
    if bound != port:
        say(f"port {port} is taken")
    say(f"viewer: {addresses(host, bound)}")
    return server


def addresses(host: str, port: int) -> str:
    """Return the address of a server on `host` at `port`, and the one for other machines if it listens for them."""
    if host in EVERYWHERE:  # no address that a browser can open on every system
        return f"http://localhost:{port} (from other machines: http://{socket.gethostname()}:{port})"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def close_server(server: viser.ViserServer) -> None:
    """Stop a `server`; browsers keep their last picture."""
    with redirect_stdout(io.StringIO()):  # viser prints a message
        server.stop()


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a `host`."""
    try:
        return host in LOOPBACK or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_allowed(origin: str | None, host: str | None, is_local: bool) -> bool:
    """Return whether a page may connect: the viewer's own page, and programs other than browsers.

    A browser lets any page connect to any address, and states which page it is. On the loopback interface the page must
    be from the loopback interface too, so that a foreign name cannot pretend to be it.

    Args:
        origin: header Origin of the connection; None if there is none.
        host: header Host.
        is_local: whether the server listens on the loopback.
    """
    if origin is None:
        return True
    try:
        page = urlsplit(origin)
        if is_local and (page.hostname is None or not is_loopback(page.hostname)):
            return False
    except ValueError:
        return False
    return page.scheme in ("http", "https") and page.netloc == host


def _refuse(server: Any, is_local: bool) -> None:
    """Refuse connections from other pages, and requests to make the viewer public through viser's relay."""
    from viser import _messages

    infra = server._websock_server

    async def check(connection: Any) -> None:
        live = infra._live_connections[connection.client_id]
        headers = live.request.headers
        if not is_allowed(headers.get("Origin"), headers.get("Host"), is_local):
            tunnel = f"ssh -L {server.get_port()}:localhost:{server.get_port()} HOST"
            say(f"viewer: refused the page {headers.get('Origin')!r:.100}, not its own; from elsewhere: {tunnel}")
            await live.close(1008, "only the viewer's own page may connect")

    infra._client_connect_cb.insert(0, check)
    infra.unregister_handler(_messages.ShareUrlRequest)
    infra.unregister_handler(_messages.ShareUrlDisconnect)


class _OneLine(logging.Handler):
    """A log of one line per problem, where the libraries would print a traceback."""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        reason = f": {type(error).__name__}" if error is not None else ""
        # Browsers open connections in advance that they do not use.
        if record.levelno >= logging.ERROR and record.getMessage() != "opening handshake failed":
            say(f"viewer: ignoring a connection with invalid data{reason}")


def _shorten_log() -> None:
    for name in ("websockets.server", "asyncio"):
        logger = logging.getLogger(name)
        if not any(isinstance(handler, _OneLine) for handler in logger.handlers):
            logger.addHandler(_OneLine())
            logger.propagate = False
