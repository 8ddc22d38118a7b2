"""A teacher: a trained renderable that renders views for a pupil in training, in the pupil's scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError, NerfloomError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.moved import moved_cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.geometry.points import Points
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.ray_model import RayModel
from nerfloom.renderable import Renderable, RendersFromImages, parts, refined_cameras
from nerfloom.rendering.rendered import Picture
from nerfloom.samplers.base import SkipsCells
from nerfloom.training.loaded import Loaded
from nerfloom.training.run_path import config_file


class Teacher:
    """A renderable that is asked in the scene of a pupil.

    The two scenes may place the same input differently. One similarity connects the two scenes, in float64, since the
    input may be millions of units from its origin.

    Args:
        model: the renderable, on the pupil's device.
        placement: placement of the input in the renderable's scene.
        pupil: placement of the input in the pupil's scene.
    """

    def __init__(self, model: Renderable, placement: Placement, pupil: Placement) -> None:
        self.model = model
        self.rotation, self.scale, self.shift = pupil.similarity_to(placement)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return `cameras` of the pupil's data in the teacher's scene, where its refined poses lead."""
        moved = moved_cameras(cameras, self.rotation, self.scale, self.shift)
        return refined_cameras(self.model, moved, training=False)

    @torch.no_grad()
    def picture(self, view: View, background: Tensor) -> Picture:
        """Return the picture of a view, with colours in [0, 1] and distances in the pupil's scene units.

        Args:
            view: a view in the pupil's scene.
            background: (3,) colour in [0, 1] of the background.
        """
        time = view.time if self.model.scene.moving else None
        shown = self.model.render_view(replace(view, camera=self.cameras(view.camera), time=time), background)
        return replace(
            shown,
            rgb=shown.rgb.float().clamp(0, 1),
            depth=shown.depth.float() / self.scale,
            median_depth=shown.median_depth.float() / self.scale,
            accumulation=shown.accumulation.float().clamp(0, 1),
        )

    def field_model(self) -> RayModel[Any]:
        """Return the renderable; its field can be evaluated at any position.

        Raises:
            ConfigError: if it has no such field.
        """
        model, reason = self.model, None
        if not isinstance(model, RayModel):
            reason = "it has no field, as runs of methods that cast rays have"
        elif isinstance(model, RendersFromImages):
            reason = "its field needs photographs beside positions"
        elif model.scene.moving:
            reason = "its scene moves"
        if reason is not None or not isinstance(model, RayModel):
            raise ConfigError(
                f"--teacher: {reason}, so it cannot be asked at points; its pictures can be learnt from: "
                "--distill-steps 0 --teacher-share 0.5"
            )
        return model

    @torch.no_grad()
    def at_points(self, positions: Tensor, directions: Tensor, size: float) -> tuple[Tensor, Tensor]:
        """Return density (N,), in 1/pupil's scene unit, and colour (N, 3) in [0, 1] at points.

        The density is 0 where the teacher's sampler skips cells.

        Args:
            positions: (N, 3) in the pupil's scene.
            directions: (N, 3) unit viewing directions in the pupil's scene.
            size: size of the points, the pupil's scene units.

        Raises:
            ConfigError: as `field_model`.
        """
        model, size = self.field_model(), self.scale * size
        rotation, shift = self.rotation.to(positions), self.shift.to(positions)
        # Sums of products, because a GPU may round a matrix product.
        places = self.scale * (rotation * positions[:, None]).sum(-1) + shift
        ahead = (rotation * directions[:, None]).sum(-1)
        points = Points(places, None, torch.full_like(places[:, 0], size / 2)).sized(size / 12**0.5)
        with model.rendering():
            sigma, features = model.field.density(points)
            rgb = model.field.color(features, ahead)
        kept = _sampled(model, places)
        return torch.where(kept, self.scale * sigma.float(), 0.0), rgb.float()


def _sampled(model: RayModel[Any], positions: Tensor) -> Tensor:
    """Return whether a model's sampler has samples at positions (N, 3): (N,) bool."""
    grids = parts(model, SkipsCells)
    if not grids:
        return torch.ones_like(positions[:, 0], dtype=torch.bool)
    grid = grids[0]
    low, high = nested_boxes(grid.box, grid.levels)[-1]
    occupied = grid.occupied_when()
    cells = Occupancy(occupied, grid.box, grid.resolution, grid.levels).cells(positions)
    return ((positions >= low) & (positions <= high)).all(-1) & occupied[cells]


def load_teacher(path: Path, dataset: Dataset) -> Teacher:
    """Load the teacher of a training.

    Args:
        path: folder of a run, or its config.yml; a file of Gaussians; or an octree.
        dataset: the pupil's training images, on its device.

    Raises:
        ConfigError: if there is no such teacher, it cannot be read, or it cannot show the images' scene.
    """
    from nerfloom.training.load import load  # here, because most trainings have no teacher

    threads = torch.get_num_threads()
    try:
        found = config_file(path)
        if path.is_dir() and found.parent != path:
            raise ConfigError(f"{path} is a folder of runs; name one of them, such as {found.parent}")
        loaded = load(found, device_type=dataset.device.type)
    except NerfloomError as error:
        raise ConfigError(f"--teacher: {error}") from error
    finally:
        torch.set_num_threads(threads)  # the pupil's number, not the number in the teacher's settings
    teacher = Teacher(loaded.model, loaded.input_placement, dataset.placement)
    if (reason := _unsuitable(loaded, teacher, dataset)) is not None:
        raise ConfigError(f"--teacher {path}: {reason}")
    return teacher


def _unsuitable(loaded: Loaded, teacher: Teacher, dataset: Dataset) -> str | None:
    """Return why a teacher cannot show the scene of training images; None if it can."""
    scene, drawn, cameras = loaded.model.scene, loaded.model.cameras, dataset.cameras
    if scene.warped or dataset.scene.warped:
        return "normalised device coordinates (--ndc) are of one set of cameras alone; train both without"
    if max(scene.num_scenes, dataset.scene.num_scenes) > 1:
        return "a teacher shows one scene, and here are several"
    if scene.moving and dataset.times is None:
        return "its scene moves, and the photographs have no times"
    if drawn is not None and cameras.model not in drawn:
        return f"{loaded.method} cannot draw {cameras.model} cameras, only {', '.join(drawn)}"
    origins = teacher.cameras(cameras).camera_to_worlds[:, :, 3]
    low, high = scene.box.to(origins)
    away = float((origins - origins.clamp(low, high)).norm(dim=-1).min())
    if not away < scene.far:
        return f"its scene is {away:,.0f} of its units from the nearest camera; was it trained on other data?"
    return None
