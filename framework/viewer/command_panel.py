"""The progress of a command that a browser has started, and the download of the file that it writes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from nerfloom.viewer.commands import Commands, follow
from nerfloom.viewer.markdown import plain

if TYPE_CHECKING:
    import viser

MAX_DOWNLOAD = 2**29
"""Maximum size of a file that is sent to a browser, bytes."""


class CommandPanel:
    """A bar, a line of text and a button of one browser.

    Only the file that its last command has written is sent. A browser cannot name a file. It receives the file once,
    because a file is in memory while it is sent, and a browser could request it repeatedly without reading it.

    Args:
        client: the browser.
        commands: the commands of all browsers.
    """

    def __init__(self, client: viser.ClientHandle, commands: Commands) -> None:
        self._client, self._commands = client, commands
        self._file: Path | None = None
        self._lock = threading.Lock()
        self._bar = client.gui.add_progress_bar(0.0, visible=False)
        self._note = client.gui.add_markdown("")
        self._download = client.gui.add_button("Download", visible=False)
        self._download.on_click(lambda _: self._send())

    def run(self, module: str, arguments: Sequence[object], written: Callable[[], Path]) -> None:
        """Run a `module` of a command with `arguments` to its end, and offer the file that `written()` returns."""
        last = ""

        def tell(line: str, percent: int | None) -> None:
            nonlocal last
            last = line
            self._note.content = plain(line)
            if percent is not None:
                self._bar.value = float(percent)

        process = self._commands.start(module, arguments)
        if process is None:
            self._note.content = "Another command is running; wait until it has ended."
            return
        self._file, self._download.visible = None, False
        self._bar.value, self._bar.visible = 0.0, True
        self._note.content = "Starting ..."
        status = follow(process, tell)
        self._bar.visible = False
        if status:
            self._note.content = plain(last) if last.startswith("error: ") else "It failed; see the terminal."
        else:
            self._offer(written())

    def _offer(self, file: Path) -> None:
        size = file.stat().st_size
        limit = "" if size <= MAX_DOWNLOAD else f" It is not sent: that is above {MAX_DOWNLOAD / 1e6:.0f} MB."
        self._note.content = f"Wrote {plain(file.name)}, {size / 1e6:.2f} MB.{limit}"
        if not limit:
            self._file, self._download.visible = file, True

    def _send(self) -> None:
        """Send the file, unless it has been sent."""
        with self._lock:
            file, self._file = self._file, None
        if file is None:
            return
        self._download.visible = False
        try:
            content = file.read_bytes()
        except OSError as error:
            self._note.content = f"Cannot read {plain(file.name)}: {error.strerror or error}"
            return
        self._client.send_file_download(file.name, content, save_immediately=True)
        self._note.content = f"Sent {plain(file.name)}; it is also kept where the viewer runs."
