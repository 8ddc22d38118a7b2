"""Gaussians fitted to the pictures of a field, so that a method without Gaussians can be shown where only they can.

They start on the surfaces that the field's rays end on (`framework/export/points.py`), and gaussian-splatting trains
them with moves as in 3DGS-MCMC (Kheradmand et al. 2024). The Gaussians learn from pictures that the field renders, at
the training cameras and between them. A field on a CPU renders few pictures per minute, so every other step uses a
photograph, if the field aims to reproduce photographs exactly: nothing moves, light does not vary, and Gaussians can be
drawn with the lens.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.counts import counted
from nerfloom.base.device import seed_step, wait_for
from nerfloom.base.errors import ConfigError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.data.sources import BatchSource, Request
from nerfloom.export.points import several_passes
from nerfloom.geometry.alignment import nearest_rotations
from nerfloom.method import Method
from nerfloom.renderable import RendersRays
from nerfloom.splats.drawing import DRAWN
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians
from nerfloom.splats.learning import number_for, rate_factor
from nerfloom.splats.look import OURS
from nerfloom.splats.start import on_surfaces
from nerfloom.training.progress import take_all
from nerfloom.training.trainer import Trainer

PICTURES_SHARE = 0.45
"""Share of the budget for rendering pictures; the rest is for training steps."""
PICTURES = 48
"""Number of pictures that should fit into their share; determines the part of an image that each shows."""
MIN_PICTURES = 6
"""Minimum number of pictures, even if they exceed their share."""
MAX_SIDE = 800
"""Maximum longer side of an image in pixels; larger ones are reduced."""
MIN_PART = 0.5
"""Minimum share of an image's width and height that a picture shows."""
TIMED_RAYS = 8192
"""Number of rays for measuring speed."""
BETWEEN = 4
"""Every Nth picture is from between two cameras."""
MAX_GAUSSIANS, MAX_RATE = 300_000, 5.0
"""Maximum number of Gaussians, and factor of learning rates, that are chosen by the budget."""
STEPS_PER_SECOND = 25
"""Assumed steps per second when the factor of learning rates is chosen."""
SETTINGS: dict[str, Any] = {
    "max_num_iterations": None,
    "degree": MAX_DEGREE,
    "strategy": "mcmc",
    "steps_per_move": 100,
    "reduced_until": 0.0,
    "paced": False,
    # They are on surfaces already.
    "noise": 0.0,
    "opacity_penalty": 0.0,
    "scale_penalty": 0.0,
    # Pictures of a field have one light and known poses.
    "appearance": "none",
    "camera_optimizer": "off",
    "robust": "off",
    "blur": OURS.blur,  # pages and files of fitted Gaussians have this look
    "depth_loss_mult": 0.0,
    "field_depth_mult": 0.0,
    "background": "black",  # `FieldPictures` chooses it
}
"""Settings of gaussian-splatting for learning a field's pictures; the budget sets the others."""


@dataclass(frozen=True)
class Shot:
    """A picture that the field has rendered, or a photograph."""

    view: View
    """Its camera."""
    rgb: Tensor
    """(H, W, 3) light of the field."""
    through: Tensor
    """(H, W, 1) share of the background's light that arrives, where images have alpha; else 0."""
    kept: Tensor | None = None
    """(H, W) bool, pixels that count; None for all."""


class FieldPictures(BatchSource):
    """A source of a field's pictures and of photographs, in turns, over a random colour where the background is seen.

    Args:
        dataset: the training split.
        shots: pictures of the field, at least one.
        photographs: functions that load photographs, possibly none.
        background: (3,) colour behind pictures that are opaque.
    """

    def __init__(
        self, dataset: Dataset, shots: list[Shot], photographs: list[Callable[[], Shot]], background: Tensor
    ) -> None:
        self.dataset, self.shots, self.photographs, self.background = dataset, shots, photographs, background

    def draw(self, request: Request) -> ViewBatch:
        if request.step % 2 and self.photographs:
            shot = self.photographs[int(torch.randint(len(self.photographs), ()))]()
        else:
            shot = self.shots[int(torch.randint(len(self.shots), ()))]
        behind = torch.rand_like(self.background) if bool(shot.through.any()) else self.background
        weights = None if shot.kept is None else shot.kept.float()
        return ViewBatch(0, shot.view, shot.rgb + shot.through * behind, behind, weights=weights)

    def drawing_from(self, dataset: Dataset) -> FieldPictures:
        return FieldPictures(dataset, self.shots, self.photographs, self.background)


def fit_gaussians(
    model: RendersRays, splatting: Method, dataset: Dataset, cameras: Cameras, seconds: float, machine: MachineConfig
) -> Gaussians:
    """Return Gaussians that look like a field.

    Args:
        model: the model in evaluation mode.
        splatting: the method gaussian-splatting.
        dataset: the training split, on the model's device, with the cameras where they stand in its scene; the
            pictures have its times.
        cameras: M pinhole cameras of that split.
        seconds: time for pictures and steps together; more is taken where the fewest pictures take longer than theirs.
        machine: seed and device.

    Raises:
        ConfigError: if no training ray ends on a surface.
    """
    begun = time.perf_counter()
    seed_step(machine.seed, 0)
    most = number_for(seconds, MAX_GAUSSIANS)
    surfaces = several_passes(model, dataset, most)
    points, colors = surfaces.positions.to(model.device), surfaces.colors.to(model.device)
    if not len(points):
        raise ConfigError("no training ray ends on a surface, so there is nothing to show; is the run trained?")
    shots = _shots(model, dataset, cameras, PICTURES_SHARE * seconds)
    photographs = _photographs(dataset)
    height, width = shots[0].rgb.shape[:2]
    say(
        f"learning from {len(shots)} pictures of the field, of {width} x {height}, and from {len(photographs)}"
        f" photographs; {len(points):,} points on surfaces"
    )
    own_share = (1 - PICTURES_SHARE) * seconds
    settings: Any = splatting.config
    config = replace(
        settings,
        **SETTINGS,
        # On a slow machine even the fewest pictures exceed their share; training still needs time.
        max_seconds=max(seconds - (time.perf_counter() - begun), own_share),
        num_gaussians=most,
        rate_factor=rate_factor(STEPS_PER_SECOND * own_share, MAX_RATE),
        machine=machine,
    )
    learnt = replace(dataset, cameras=cameras, scene=replace(dataset.scene, num_scenes=1))
    trainer = Trainer(splatting, config, learnt, source=FieldPictures(learnt, shots, photographs, model.background))
    trainer.prepare(start=False)
    fitted: Any = trainer.model
    fitted.set_gaussians(on_surfaces(points, colors, MAX_DEGREE))
    take_all(trainer.steps(), "Fitting Gaussians")
    found, dropped = fitted.gaussians(), trainer.state.skipped
    without = f" ({dropped:,} dropped: gradients not finite)" if dropped else ""
    say(f"{counted(len(found), 'Gaussians')} after {counted(trainer.state.step, 'steps')}{without}")
    return found


# -- pictures -----------------------------------------------------------------------------------------------------


def _shots(model: RendersRays, dataset: Dataset, cameras: Cameras, seconds: float) -> list[Shot]:
    """Return pictures that the model renders in about `seconds`.

    They are crops of images, since small images have too little detail.
    """
    end = time.perf_counter() + seconds
    cameras = cameras.scaled(min(1.0, MAX_SIDE / float(torch.maximum(cameras.widths, cameras.heights).max())))
    share = _part(model, dataset, cameras, seconds)
    shots: list[Shot] = []
    for camera, index in track(_order(cameras), "Rendering pictures", total=PICTURES):
        if len(shots) >= MIN_PICTURES and time.perf_counter() > end:
            break
        moment = None if dataset.times is None else float(dataset.times[index])
        shots.append(_shot(model, cropped(camera, share), moment))
    return shots


def _part(model: RendersRays, dataset: Dataset, cameras: Cameras, seconds: float) -> float:
    """Return the side of pictures relative to images, such that PICTURES, or two per camera, take `seconds`."""
    pixels = float((cameras.widths * cameras.heights).double().mean())
    moment = None if dataset.times is None else float(dataset.times[0])
    background = model.background
    stride = max(int(math.sqrt(pixels / TIMED_RAYS)), 1)
    model.render_view(View(cameras[:1], moment, stride=8 * stride), background)  # warms up
    start, view = time.perf_counter(), View(cameras[:1], moment, stride=stride)
    model.render_view(view, background)
    wait_for(model.device)
    each = (time.perf_counter() - start) / (view.width * view.height)
    wanted = min(PICTURES, 2 * len(cameras))
    return min(max(math.sqrt(seconds / (each * pixels * wanted)), MIN_PART), 1.0)


def cropped(camera: Cameras, share: float) -> Cameras:
    """Return one `camera` for a random part of its image, a `share` of its width and height."""
    sizes = [max(int(share * int(side[0])), 1) for side in (camera.widths, camera.heights)]
    free = [int(side[0]) - size for side, size in zip((camera.widths, camera.heights), sizes, strict=True)]
    left, top = (int(torch.randint(room + 1, ())) for room in free)
    return replace(
        camera,
        cx=camera.cx - left,
        cy=camera.cy - top,
        widths=torch.full_like(camera.widths, sizes[0]),
        heights=torch.full_like(camera.heights, sizes[1]),
    )


def _order(cameras: Cameras) -> Iterator[tuple[Cameras, int]]:
    """Yield cameras to take pictures with, and the numbers of the training cameras that they are or are next to."""
    count = len(cameras)
    order = torch.randperm(count).tolist()
    for rank, index in enumerate(order):
        yield cameras[index : index + 1], index
        if rank % (BETWEEN - 1) == BETWEEN - 2 and (middle := between(cameras, index)) is not None:
            yield middle, index
    for index in order:
        if (middle := between(cameras, index)) is not None:
            yield middle, index


def between(cameras: Cameras, index: int) -> Cameras | None:
    """Return a camera half way from number `index` of M `cameras` to the nearest; None if that looks elsewhere."""
    poses = cameras.camera_to_worlds.double()
    distances = (poses[:, :, 3] - poses[index, :, 3]).norm(dim=-1)
    distances[index] = torch.inf
    other = int(distances.argmin())
    if other == index or float(poses[index, :, 2] @ poses[other, :, 2]) < 0.5:
        return None
    mean = ((poses[index] + poses[other]) / 2)[None]
    pose = torch.cat([nearest_rotations(mean[:, :, :3]), mean[:, :, 3:]], -1).to(cameras.camera_to_worlds)
    return replace(cameras[index : index + 1], camera_to_worlds=pose)


def _shot(model: RendersRays, camera: Cameras, moment: float | None) -> Shot:
    view, background = View(camera, moment), model.background
    picture = model.render_view(view, background)
    rgb, through = picture.rgb.clamp(0, 1).float(), torch.zeros_like(picture.rgb[..., :1], dtype=torch.float32)
    if model.scene.has_alpha:
        through = (1 - picture.accumulation.float().clamp(0, 1))[..., None]
        rgb = (rgb - through * background).clamp(0, 1)
    return Shot(view, rgb, through)


def _photographs(dataset: Dataset) -> list[Callable[[], Shot]]:
    """Return functions that load photographs; none if the field does not aim to reproduce them exactly."""
    if dataset.times is not None or dataset.cameras.model not in DRAWN or dataset.scene.appearance_varies:
        return []
    return [partial(_photograph, dataset, index) for index in range(len(dataset))]


def _photograph(dataset: Dataset, index: int) -> Shot:
    """Return a photograph, or a random part of a large one."""
    camera = dataset.cameras[index : index + 1]
    height, width = int(camera.heights[0]), int(camera.widths[0])
    part = cropped(camera, min(1.0, MAX_SIDE / max(height, width)))
    left, top = round(float(camera.cx[0] - part.cx[0])), round(float(camera.cy[0] - part.cy[0]))
    where = slice(top, top + int(part.heights[0])), slice(left, left + int(part.widths[0]))
    image, kept = dataset.image(index)[where].float() / 255, dataset.kept_of(index)
    alpha = image[..., 3:] if image.shape[-1] == 4 else torch.ones_like(image[..., :1])
    shown = None if kept is None else kept[where].to(image.device)
    return Shot(View(part), image[..., :3] * alpha, 1 - alpha, shown)
