"""Image files of selected evaluated views, and of the view with the lowest PSNR."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from nerfloom.evaluation.images import write_image
from nerfloom.evaluation.panels import as_colors, composed, view_panels
from nerfloom.rendering.rendered import Picture

WORST = "worst"
"""Name, without suffix, of the files of the view with the lowest PSNR; the next evaluation overwrites them."""
MAX_STEM_LENGTH = 150
"""Maximum number of bytes of an image's name within names of written files."""


class Judged(NamedTuple):
    """Images of an evaluated view."""

    rgb: Tensor
    """(H, W, 3) rendered colours as used for metrics."""
    target: Tensor
    """(H, W, 3) colours of the true image."""
    picture: Picture
    """The rendered picture."""


class ViewFiles:
    """Writer of the files of the evaluated `views`, and `with_worst` of the worst one, into `folder` unless None.

    `names` has the names of all images.
    """

    def __init__(self, folder: Path | None, names: Sequence[str], views: Collection[int], with_worst: bool) -> None:
        self._folder, self._names, self._views, self._with_worst = folder, names, views, with_worst
        self._lowest = math.inf
        self._worst: Judged | None = None
        self.note: str | None = None
        """Reason why files could not be written; None if there was no problem."""

    def take(self, index: int, psnr: float, judged: Judged) -> None:
        """Write the files of view `index`, from `judged`, or keep them if its `psnr` in dB is the worst so far."""
        if self._with_worst and psnr < self._lowest:
            self._lowest, self._worst = psnr, judged
        if index in self._views:
            self._write(f"{index:04d}_{_short_stem(self._names[index])}", judged)

    def write_worst(self) -> None:
        """Write the files of the view with the lowest PSNR."""
        if self._worst is not None:
            self._write(WORST, self._worst)

    def _write(self, stem: str, judged: Judged) -> None:
        """Write the files of a view (render, photograph, comparison, further outputs), unless writing has failed."""
        if self._folder is None or self.note is not None:
            return
        rgb, target, picture = judged
        files = {"": rgb, "_photograph": target, "_comparison": composed(view_panels(rgb, target, picture))}
        files |= {f"_{output.name}": as_colors(picture, output)[0] for output in picture.outputs}
        try:
            for suffix, image in files.items():
                write_image(self._folder / f"{stem}{suffix}.png", image)
        except OSError as error:  # metrics are computed without the files
            self.note = f"cannot write pictures to {self._folder}: {error.strerror or error}"


def _short_stem(name: str) -> str:
    """Return an image's name without its extension, cut to `MAX_STEM_LENGTH` bytes."""
    return os.fsencode(Path(name).stem)[:MAX_STEM_LENGTH].decode("utf-8", "ignore")
