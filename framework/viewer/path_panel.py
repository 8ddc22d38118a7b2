"""The path editor of one browser: add cameras, preview, save and render a path."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfloom.base.console import say
from nerfloom.cameras.camera_path import CameraPath, Keyframe, write_camera_path
from nerfloom.evaluation.video_suffixes import default_video
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.command_panel import CommandPanel
from nerfloom.viewer.commands import Commands
from nerfloom.viewer.keyframes import MAX_KEYFRAMES, Editor, listed, path_file
from nerfloom.viewer.request import Request, number_in
from nerfloom.viewer.viewpoint import Move

if TYPE_CHECKING:
    import viser

LINE = "/camera_path"
"""Name of the path in the scene."""
MAX_PREVIEW_FPS = 20.0
"""Maximum number of cameras per second in a preview."""
NOTHING = "-"
"""Entry in the list of cameras while it is empty."""


class PathPanel:
    """Controls of one browser for a camera path.

    Args:
        client: the browser.
        loaded: function that returns the model and its run.
        request: function that returns the browser's request; None if its camera is invalid.
        move: moves the browser's camera.
        commands: the commands of all browsers; None if they may start none.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        loaded: Callable[[], Loaded],
        request: Callable[[], Request | None],
        move: Move,
        commands: Commands | None,
    ) -> None:
        self._client, self._loaded, self._request, self._move = client, loaded, request, move
        self._commands = commands
        self._editor = Editor()
        self._playing = False
        gui = client.gui
        gui.add_button("Add this camera").on_click(lambda _: self._edit(self._added))
        self._chosen = gui.add_dropdown("Camera", [NOTHING])
        gui.add_button_group("Chosen", ["go to", "move here", "remove"]).on_click(self._change)
        self._seconds = gui.add_slider("Seconds between", 0.1, 20.0, 0.1, 2.0)
        self._fps = gui.add_number("Frames per second", round(Editor.fps), min=1, max=120, step=1)
        self._closed = gui.add_checkbox("Closed", False, hint="The path returns to its first camera.")
        for handle in (self._seconds, self._fps, self._closed):
            handle.on_update(lambda _: self._edit(lambda editor: editor))
        self._preview = gui.add_button("Preview")
        self._preview.on_click(lambda _: self._play())
        self._width = gui.add_number("Width", 1280, min=16, max=8192, step=2, hint="Of the video, pixels.")
        self._height = gui.add_number("Height", 720, min=16, max=8192, step=2, hint="Of the video, pixels.")
        self._name = gui.add_text("Name", "", hint="Letters, digits, - and _; camera_path.json if empty")
        gui.add_button("Save").on_click(lambda _: self._save())
        self._note = gui.add_markdown("")
        if commands is not None:
            button = gui.add_button("Save and render")
            command, opens = CommandPanel(client, commands), commands.opens
            button.on_click(lambda _: self._render(command, opens))

    def close(self) -> None:
        """Stop the preview when the browser has left."""
        self._playing = False

    # -- editing ----------------------------------------------------------------------------------------------

    def _keyframe(self) -> Keyframe | None:
        request = self._request()
        if request is None:
            return None
        return Keyframe(request.pose.tensor(), math.degrees(request.pose.fov), request.time)

    def _added(self, editor: Editor) -> Editor:
        keyframe = self._keyframe()
        if keyframe is not None and len(editor.keyframes) == MAX_KEYFRAMES:
            self._note.content = f"A path has at most {MAX_KEYFRAMES} cameras."
        return editor if keyframe is None else editor.added(keyframe)

    def _change(self, event: Any) -> None:
        index = int(number_in(_or_zero(self._chosen.value), 0, MAX_KEYFRAMES, 0)) - 1
        if not 0 <= index < len(self._editor.keyframes):
            self._note.content = "Add a camera first."
            return
        action, keyframe = event.target.value, self._keyframe()
        if action == "go to":
            chosen = self._editor.keyframes[index]
            self._move(chosen.pose, math.radians(chosen.fov), chosen.time)
        elif action == "remove":
            self._edit(lambda editor: editor.without(index))
        elif action == "move here" and keyframe is not None:
            self._edit(lambda editor: editor.moved(index, keyframe))

    def _edit(self, change: Callable[[Editor], Editor]) -> None:
        """Change the path and show it."""
        before = len(self._editor.keyframes)
        self._editor = replace(
            change(self._editor),
            seconds=number_in(self._seconds.value, 0.1, 20.0, 2.0),
            fps=number_in(self._fps.value, 1, 120, Editor.fps),
            closed=self._closed.value is True,
        )
        count = len(self._editor.keyframes)
        if count != before:
            self._chosen.options = listed(self._editor) or [NOTHING]
            self._chosen.value = str(count) if count else NOTHING
        path = self._path()
        seconds = 0.0 if path is None else path.seconds
        self._note.content = f"{count} camera{'' if count == 1 else 's'}, {seconds:.1f} s"
        self._show(path)

    def _path(self) -> CameraPath | None:
        width, height = (round(number_in(one.value, 16, 8192, 720)) for one in (self._width, self._height))
        return self._editor.path(width, height, self._loaded().input_placement)

    def _show(self, path: CameraPath | None) -> None:
        """Draw the path as a line in the scene."""
        self._client.scene.remove_by_name(LINE)
        if path is not None:
            points = path.poses[:, :, 3].numpy().astype(np.float32)
            points = points[:: -(-len(points) // 1000)]
            pairs = np.stack([points[:-1], points[1:]], axis=1)
            self._client.scene.add_line_segments(
                LINE, pairs, np.array([220, 40, 90], np.uint8), thickness=2.0, thickness_units="screen"
            )

    # -- preview ----------------------------------------------------------------------------------------------

    def _play(self) -> None:
        """Move the browser's camera along the path, or stop it."""
        if self._playing:
            self._playing = False
            return
        path = self._path()
        if path is None:
            self._note.content = "A path needs two cameras."
            return
        self._playing, self._preview.label = True, "Stop"
        start = time.monotonic()
        try:
            while self._playing and (passed := time.monotonic() - start) < path.seconds:
                index = min(int(passed * path.fps), len(path) - 1)
                moment = None if path.times is None else float(path.times[index])
                self._move(path.poses[index], math.radians(float(path.fovs[index])), moment)
                self._client.flush()
                time.sleep(1 / min(MAX_PREVIEW_FPS, path.fps))
        finally:
            self._playing, self._preview.label = False, "Preview"

    # -- files ------------------------------------------------------------------------------------------------

    def _save(self) -> Path | None:
        """Write the path beside the run or file, and return its file; None if that was not possible."""
        path, folder = self._path(), self._loaded().folder
        if path is None:
            self._note.content = "A path needs two cameras."
            return None
        file = path_file(folder, self._name.value)
        try:
            write_camera_path(file, path)
        except OSError as error:
            self._note.content = f"Cannot write {file.name}: {error.strerror or error}"
            return None
        opens = [str(self._loaded().origin)] if self._commands is None else self._commands.opens
        words = ["--camera-path-filename", str(file), "--output-path", str(default_video(file.stem)), *opens]
        say(f"viewer: saved {file}; render it with: ns-render camera-path {shlex.join(words)}")
        self._note.content = f"Saved {file.name}, {len(path)} frames."
        return file

    def _render(self, command: CommandPanel, opens: Sequence[str]) -> None:
        """Start ns-render on the path in another process; the words `opens` name the scene."""
        file = self._save()
        if file is not None:
            output = file.with_name(default_video(file.stem).name)
            words = ["camera-path", "--camera-path-filename", file, "--output-path", output, *opens]
            command.run("nerfloom.cli.render", words, lambda: output)


def _or_zero(value: Any) -> int:
    return int(value) if isinstance(value, str) and value.isdecimal() and len(value) < 9 else 0
