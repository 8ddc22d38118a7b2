"""Gaussians that are edited, their placement, and the photographs that show them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import UP, Placement, rotation_between
from nerfloom.cameras.scale import Scale
from nerfloom.edit.similarity import Similarity
from nerfloom.export.run_gaussians import finite, moment_of
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.placed_files import capture_cameras, in_input, write_placed
from nerfloom.splats.spz_container import SpzVersion
from nerfloom.splats.transform import transformed, transformed_in_float64
from nerfloom.training.loaded import Loaded


@dataclass(frozen=True, eq=False)
class Edited:
    """Gaussians that are edited. A step returns another one, and changes none."""

    gaussians: Gaussians
    """N Gaussians on the CPU, in the frame and unit of exports, as steps have moved it; centres in float64."""
    look: Look = OURS
    """The settings of drawing."""
    scale: Scale = field(default_factory=Scale)
    """The unit of their coordinates. Its name is empty after lengths have changed, until `scale` names it."""
    placement: Placement = field(default_factory=lambda: Placement.of(None, 1.0))
    """Placement of their frame in the scene of `loaded`."""
    loaded: Loaded | None = None
    """The run or file that they are from; None for others."""
    up: Tensor | None = None
    """(3,) float64 direction of their frame that `set_up` or `align_floor` has made up; it turns with the Gaussians.
    None for the up direction of the scene of `loaded`."""

    @classmethod
    def of(cls, loaded: Loaded, time: float | None = None) -> Edited:
        """Return the finite Gaussians of a run or a file.

        Args:
            loaded: the run or file.
            time: time in [0, 1] of a moving scene; None for 0.

        Raises:
            ConfigError: if it has no Gaussians, or no scale (normalised device coordinates).
        """
        model = loaded.model
        if not isinstance(model, HasGaussians):
            raise ConfigError(
                f"{loaded.origin}: {loaded.method} has no Gaussians to edit; ns-train gaussian-splatting makes them"
            )
        if model.scene.warped:
            raise ConfigError("this run is in normalised device coordinates (--ndc), which have no scale to edit in")
        found = model.gaussians(moment_of(model.scene.moving, time))
        good = finite(found, f"{loaded.origin} has no Gaussians left; train it again")
        return cls(in_input(good, loaded.placement), model.look(), loaded.scale, loaded.placement, loaded)

    def __len__(self) -> int:
        return len(self.gaussians)

    def kept(self, mask: Tensor) -> Edited:
        """Return the Gaussians that a `mask` (N,) bool or an index (K,) int64 selects."""
        return replace(self, gaussians=self.gaussians[mask])

    def moved(self, similarity: Similarity) -> Edited:
        """Return the Gaussians in a frame that they are moved to, with their axes and harmonics.

        The name of the unit is no longer known if lengths change.

        Args:
            similarity: from the old frame to the new one.
        """
        rotation, scale, shift = similarity
        applied = torch.eye(4, dtype=torch.float64)
        applied[:3, :3], applied[:3, 3] = rotation, shift / scale
        return replace(
            self,
            gaussians=transformed_in_float64(self.gaussians, rotation, scale, shift),
            placement=self.placement.after(applied, scale),
            scale=self.scale if scale == 1 else replace(self.scale, factor=scale * self.scale.factor, unit=""),
            up=None if self.up is None else rotation @ self.up,
        )

    def in_scene(self) -> Gaussians:
        """Return the Gaussians in the scene of `loaded`, float32, on the device of its model.

        Raises:
            ConfigError: as `photographed`.
        """
        device = self.photographed("this").model.device
        placed = transformed(self.gaussians, *self.placement.similarity())
        return placed.map(lambda values: values.to(device))

    def write(self, file: str | Path, max_megabytes: float | None = None, spz_version: SpzVersion = 2) -> list[str]:
        """Write the Gaussians in the format of the file's suffix, about a local origin if they are far from theirs.

        In a .glb file, everything is turned so that `upwards` is +y.

        Args:
            file: path of the file, with a suffix of `nerfloom.splats.files.SUFFIXES`.
            max_megabytes: maximum size of the file in millions of bytes; None for any.
            spz_version: version of an SPZ file.

        Returns:
            Sentences about losses and the local origin.

        Raises:
            ConfigError: if the format cannot hold the Gaussians, or no file fits the size.
            OSError: if the file cannot be written.
        """
        turned = torch.eye(4, dtype=torch.float64)[:3]
        turned[:, :3] = rotation_between(self.upwards, UP)
        placement = Placement(turned, 1.0)
        cameras = None if self.loaded is None else capture_cameras(self.loaded.model, self.placement)
        kept = None if cameras is None else cameras.placed(placement)
        path = Path(file)
        return write_placed(path, self.gaussians, self.look, self.scale, placement, max_megabytes, spz_version, kept)

    def photographed(self, step: str) -> Loaded:
        """Return the run or file with photographs of the Gaussians, which the step named `step` needs.

        Raises:
            ConfigError: if photographs are not known.
        """
        if self.loaded is None or self.loaded.source is None:
            raise ConfigError(f"{step} needs the photographs: edit a run, or give --data DIR")
        return self.loaded

    @property
    def upwards(self) -> Tensor:
        """Direction (3,) float64 of their frame that is up, of unit length."""
        found = self.placement.up if self.up is None else self.up
        return found / found.norm()

    @property
    def has_photographs(self) -> bool:
        """True if photographs are known."""
        return self.loaded is not None and self.loaded.source is not None
