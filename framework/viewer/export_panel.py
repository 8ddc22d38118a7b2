"""The exports of one browser, which `ns-export` writes with the crop and time that are shown."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from nerfloom.export.kinds import KINDS, kinds_of
from nerfloom.geometry.regions import write_regions
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.command_panel import CommandPanel
from nerfloom.viewer.commands import Commands
from nerfloom.viewer.crop_panel import FILE, CropPanel
from nerfloom.viewer.markdown import plain
from nerfloom.viewer.request import Request, one_of

if TYPE_CHECKING:
    import viser

FOLDER = "exports"
"""Folder of exports in the folder of a run or a file."""
PREFERRED = "gaussian-splat", "pointcloud", "web"
"""Kinds of exports from the most to the least wanted. The first that suits is chosen when the panel opens."""


class ExportPanel:
    """Controls of one browser for exports.

    Args:
        client: the browser.
        loaded: function that returns the model and its run.
        request: function that returns the browser's request; None if its camera is invalid.
        crop: the crop of the browser.
        commands: the commands of all browsers.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        loaded: Callable[[], Loaded],
        request: Callable[[], Request | None],
        crop: CropPanel,
        commands: Commands,
    ) -> None:
        self._loaded, self._request, self._crop, self._opens = loaded, request, crop, commands.opens
        self._choices = choices(loaded())
        gui, folder = client.gui, folder_of(loaded()).relative_to(loaded().folder).as_posix()
        gui.add_markdown(f"Exports what the crop leaves, at the time shown, into the folder {plain(folder)}.")
        kinds = [name for name, _ in self._choices.values()]
        first = kinds.index(next(name for name in PREFERRED if name in kinds))
        self._kind = gui.add_dropdown("What", list(self._choices), initial_value=list(self._choices)[first])
        gui.add_button("Export").on_click(lambda _: self._export())
        self._note = gui.add_markdown("")
        self._command = CommandPanel(client, commands)

    def _export(self) -> None:
        """Start ns-export in another process."""
        name, suffix = self._choices[one_of(self._kind.value, list(self._choices))]
        regions = self._crop.regions()
        if regions and not KINDS[name].is_cropped:
            self._note.content = f"{name} takes no crop: switch the box off, and undo selections."
            return
        self._note.content = ""
        folder = folder_of(self._loaded())
        words: list[object] = [name, "--output-dir", folder, *self._flags(name, suffix)]
        try:
            # Not in the run's folder: another browser may save its crop there before the process has read this one.
            with TemporaryDirectory(prefix="nerfloom-") as temporary:
                if regions:
                    file = Path(temporary) / FILE
                    write_regions(file, regions)
                    words += ["--region", file]
                self._command.run("nerfloom.cli.export", [*words, *self._opens], lambda: newest(folder, suffix))
        except OSError as error:
            self._note.content = f"Cannot export: {plain(error.strerror or str(error))}."

    def _flags(self, name: str, suffix: str) -> list[object]:
        """Return the flags of ns-export for a kind of export, a suffix, and the picture's time."""
        kind, request = KINDS[name], self._request()
        flags = list[object]()
        if len(kind.suffixes) > 1:
            flags += ["--format", suffix.removeprefix(".")]
        has_time = any(field.name == "time" for field in dataclasses.fields(kind.settings))
        if has_time and request is not None and request.time is not None:
            flags += ["--time", request.time]
        return flags


def choices(loaded: Loaded) -> dict[str, tuple[str, str]]:
    """Return the kinds of exports that suit a run or a file, and the suffixes of their files, by name in the list."""
    return {f"{name} {end}": (name, end) for name, kind in kinds_of(loaded).items() for end in kind.suffixes}


def folder_of(loaded: Loaded) -> Path:
    """Return the folder of the exports of a run or a file. Exports of other files have the same names."""
    together = loaded.folder / FOLDER
    return together if loaded.is_run else together / loaded.origin.stem


def newest(folder: Path, suffix: str) -> Path:
    """Return the file with a `suffix` in a `folder`, which has one, that was written last."""
    return max(folder.glob(f"*{suffix}"), key=lambda file: file.stat().st_mtime_ns)
