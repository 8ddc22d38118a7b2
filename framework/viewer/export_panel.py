"""The exports of one browser, which `ns-export` writes with the crop and time that are shown."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from nerfloom.export.kinds import KINDS
from nerfloom.geometry.regions import write_region
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.command_panel import CommandPanel
from nerfloom.viewer.commands import Commands
from nerfloom.viewer.crop_panel import FILE, CropPanel
from nerfloom.viewer.markdown import plain
from nerfloom.viewer.request import Request, one_of

if TYPE_CHECKING:
    import viser

FOLDER = "exports"
"""Folder of exports in the folder of a run."""
CHOICES = {f"{name} {suffix}": (name, suffix) for name, kind in KINDS.items() for suffix in kind.suffixes}
"""Kinds of exports and the suffixes of their files, by their name in the list."""


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
        self._loaded, self._request, self._crop = loaded, request, crop
        gui = client.gui
        gui.add_markdown(f"Exports the inside of the crop box, at the time shown, into the folder {FOLDER} of the run.")
        first = "gaussian-splat .ply" if isinstance(loaded().model, HasGaussians) else "pointcloud .ply"
        self._kind = gui.add_dropdown("What", list(CHOICES), initial_value=first)
        gui.add_button("Export").on_click(lambda _: self._export())
        self._note = gui.add_markdown("")
        self._command = CommandPanel(client, commands)

    def _export(self) -> None:
        """Start ns-export in another process."""
        name, suffix = CHOICES[one_of(self._kind.value, list(CHOICES))]
        region = self._crop.region()
        if region is not None and not KINDS[name].is_cropped:
            self._note.content = f"{name} takes no crop: switch the crop off."
            return
        self._note.content = ""
        folder = self._loaded().folder / FOLDER
        words = [name, self._loaded().origin, "--output-dir", folder, *self._flags(name, suffix)]
        try:
            # Not in the run's folder: another browser may save its box there before the process has read this one.
            with TemporaryDirectory(prefix="nerfloom-") as temporary:
                if region is not None:
                    file = Path(temporary) / FILE
                    write_region(file, region)
                    words += ["--region", file]
                self._command.run("nerfloom.cli.export", words, lambda: newest(folder, suffix))
        except OSError as error:
            self._note.content = f"Cannot export: {plain(error.strerror or str(error))}."

    def _flags(self, name: str, suffix: str) -> list[object]:
        """Return the flags of ns-export for a kind of export, a suffix, and the picture's time and crop."""
        loaded, kind, request = self._loaded(), KINDS[name], self._request()
        flags: list[object] = ["--device-type", loaded.model.device.type]
        data = loaded.run.config.data
        if data is not None and data.exists():  # without its photographs, a run can still export what needs none
            flags += ["--data", data]
        if len(kind.suffixes) > 1:
            flags += ["--format", suffix.removeprefix(".")]
        has_time = any(field.name == "time" for field in dataclasses.fields(kind.settings))
        if has_time and request is not None and request.time is not None:
            flags += ["--time", request.time]
        return flags


def newest(folder: Path, suffix: str) -> Path:
    """Return the file with a `suffix` in a `folder`, which has one, that was written last."""
    return max(folder.glob(f"*{suffix}"), key=lambda file: file.stat().st_mtime_ns)
