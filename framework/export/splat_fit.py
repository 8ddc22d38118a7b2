"""Gaussians fitted to the pictures of a field, so that a method without Gaussians can be shown where only they can.

They start on the surfaces that the field's rays end on (`framework/export/points.py`), and are then trained as in 3D
Gaussian Splatting (Kerbl et al. 2023), with moves as in MCMC (Kheradmand et al. 2024). They learn from pictures that
the field renders, not from photographs: they are to show what it has learnt.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from framework.base.console import say, track
from framework.base.device import seed_step, wait_for
from framework.base.errors import ConfigError
from framework.base.optimised import RowChange
from framework.cameras.cameras import Cameras
from framework.cameras.view import View
from framework.data.dataset import Dataset
from framework.evaluation.evaluator import evaluation_background
from framework.export.points import joined, surface_points
from framework.kernels.native import torch_on_one_thread
from framework.kernels.splat_project import SplatCamera
from framework.kernels.ssim import ssim
from framework.ray_model import RayModel
from framework.splats.drawing import draw, splat_camera
from framework.splats.gaussians import MAX_DEGREE, Gaussians
from framework.splats.mcmc import moved
from framework.splats.start import from_points
from framework.training.optim import Adam
from framework.training.step import backward

PICTURES_SHARE = 0.45
"""Share of the budget in which pictures are rendered; the others are steps."""
PICTURES = 48
"""Number of pictures for which their size is chosen."""
FEWEST_PICTURES = 6
"""Minimum number of pictures, whatever they take."""
SMALLEST = 0.25
"""Minimum size of a picture, as a fraction of the image's."""
BETWEEN = 4
"""One of so many pictures is from between two cameras."""
OPACITY, SIZE = 0.5, 0.7
"""Of Gaussians at the start: opacity, and standard deviation in distances to neighbours."""
RATES = {"means": 8e-5, "log_scales": 5e-3, "rotations": 1e-3, "logits": 5e-2, "colors": 2.5e-3, "harmonics": 1.25e-4}
"""Learning rates before the factor that the budget decides; of centres per scene extent."""
STEPS_PER_SECOND = 25
"""Steps a second by which that factor is chosen."""
SSIM_WEIGHT = 0.2
"""Weight of 1 - SSIM in the loss; the absolute error has the rest."""
STEPS_PER_MOVE, MOVES_END, GROWTH = 100, 0.8, 1.05
"""Steps between moves, the share of the budget after which there are none, and by how much the number grows in each."""


@dataclass(frozen=True)
class Shot:
    """A picture that the field has rendered."""

    camera: SplatCamera
    """Its camera."""
    rgb: Tensor
    """(H, W, 3) light of the field."""
    through: Tensor
    """(H, W, 1) share of the background's light that arrives, where images have alpha; else 0."""


def fit_gaussians(model: RayModel[Any], dataset: Dataset, cameras: Cameras, near: float, seconds: float) -> Gaussians:
    """Return Gaussians that look like a field.

    Args:
        model: the model in evaluation mode.
        dataset: the training split, on the model's device; its times are those of the pictures.
        cameras: M pinhole cameras of that split.
        near: smallest depth at which a Gaussian is drawn, scene units.
        seconds: time for pictures and steps together.

    Raises:
        ConfigError: if no training ray ends on a surface.
    """
    begun = time.perf_counter()
    seed_step(model.config.machine.seed, 0)
    most = number_for(seconds)
    points, colors = _surfaces(model, dataset, most * 2 // 3)
    shots = _shots(model, dataset, cameras, near, PICTURES_SHARE * seconds)
    height, width = shots[0].rgb.shape[:2]
    say(f"{len(shots)} pictures of {width} x {height}, and {len(points):,} points on surfaces")
    first = from_points(points, colors, MAX_DEGREE, OPACITY, SIZE)
    background = evaluation_background(model)
    rates = _rates(cameras, seconds)
    with torch_on_one_thread():
        return _trained(first, shots, background, rates, most, max(seconds - (time.perf_counter() - begun), 1.0))


def number_for(seconds: float) -> int:
    """Return the number of Gaussians that suits a budget of `seconds`."""
    return int(min(max(8_000 * math.sqrt(seconds), 20_000), 300_000))


def _surfaces(model: RayModel[Any], dataset: Dataset, count: int) -> tuple[Tensor, Tensor]:
    """Return about `count` points (K, 3) on surfaces and their colours (K, 3), on the model's device."""
    chunks = -(-2 * count // model.config.eval_num_rays_per_chunk)
    found = joined(track(surface_points(model, dataset, 2 * count, None), "Looking for surfaces", total=chunks))
    if not len(found.positions):
        raise ConfigError("no training ray ends on a surface, so there is nothing to show; is the run trained?")
    device = model.device
    return found.positions[:count].to(device), found.colors[:count].to(device)


# -- pictures -----------------------------------------------------------------------------------------------------


def _shots(model: RayModel[Any], dataset: Dataset, cameras: Cameras, near: float, seconds: float) -> list[Shot]:
    """Return pictures that the model renders in about so many seconds."""
    end = time.perf_counter() + seconds
    cameras = cameras.scaled(_reduction(model, dataset, cameras, seconds))
    shots: list[Shot] = []
    for camera, index in track(_order(cameras), "Rendering pictures", total=PICTURES):
        if len(shots) >= FEWEST_PICTURES and time.perf_counter() > end:
            break
        shots.append(_shot(model, camera, None if dataset.times is None else float(dataset.times[index]), near))
    return shots


def _reduction(model: RayModel[Any], dataset: Dataset, cameras: Cameras, seconds: float) -> float:
    """Return the factor of the pictures' size at which PICTURES of them, or one a camera, take so many seconds."""
    moment = None if dataset.times is None else float(dataset.times[0])
    view = View(cameras[:1], moment, stride=8)
    background = evaluation_background(model)
    model.render_view(view, background)  # what is allocated at first use does not count
    start = time.perf_counter()
    model.render_view(view, background)
    wait_for(model.device)
    each = (time.perf_counter() - start) / (view.width * view.height)
    pixels = float((cameras.widths * cameras.heights).double().mean())
    wanted = min(PICTURES, 2 * len(cameras))
    return min(max(math.sqrt(seconds / (each * pixels * wanted)), SMALLEST), 1.0)


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
    """Return a camera half way from one to the nearest other one; None if that looks elsewhere.

    Args:
        cameras: M cameras.
        index: number of the first.
    """
    poses = cameras.camera_to_worlds.double()
    distances = (poses[:, :, 3] - poses[index, :, 3]).norm(dim=-1)
    distances[index] = torch.inf
    other = int(distances.argmin())
    if other == index or float(poses[index, :, 2] @ poses[other, :, 2]) < 0.5:
        return None
    mean = (poses[index] + poses[other]) / 2
    u, _, vh = torch.linalg.svd(mean[:, :3])
    flips = torch.ones(3).to(u)
    flips[2] = torch.linalg.det(u @ vh)
    pose = torch.cat([(u * flips) @ vh, mean[:, 3:]], -1).to(cameras.camera_to_worlds)
    return replace(cameras[index : index + 1], camera_to_worlds=pose[None])


def _shot(model: RayModel[Any], camera: Cameras, moment: float | None, near: float) -> Shot:
    background = evaluation_background(model)
    picture = model.render_view(View(camera, moment), background)
    rgb, through = picture.rgb.clamp(0, 1).float(), torch.zeros_like(picture.rgb[..., :1], dtype=torch.float32)
    if model.scene.has_alpha:
        through = (1 - picture.accumulation.float().clamp(0, 1))[..., None]
        rgb = (rgb - through * background).clamp(0, 1)
    return Shot(splat_camera(camera, near), rgb, through)


# -- steps --------------------------------------------------------------------------------------------------------


def _rates(cameras: Cameras, seconds: float) -> dict[str, float]:
    """Return the learning rates of a fit of so many seconds: fewer steps have to go farther."""
    factor = min(max((30_000 / (STEPS_PER_SECOND * seconds)) ** 0.44, 1.0), 5.0)
    centers = cameras.camera_to_worlds[:, :, 3]
    extent = 1.1 * float((centers - centers.mean(0)).norm(dim=-1).max()) or 1.0
    return {name: factor * rate * (extent if name == "means" else 1) for name, rate in RATES.items()}


def _trained(
    first: Gaussians, shots: list[Shot], background: Tensor, rates: dict[str, float], most: int, seconds: float
) -> Gaussians:
    """Return Gaussians that have learnt the pictures for so many seconds."""
    tables = {name: nn.Parameter(values.reshape(len(first), -1).contiguous()) for name, values in vars(first).items()}
    groups = [{"params": [tables[name]], "name": name, "lr": rates[name], "sparse": True} for name in tables]
    optimizer = Adam(groups, {}, 1e-3, (0.9, 0.99), 1e-15)
    start, step = time.perf_counter(), 0
    for percent in track(range(100), "Fitting Gaussians", total=100):
        while (progress := (time.perf_counter() - start) / seconds) < (percent + 1) / 100:
            optimizer.param_groups[0]["lr"] = rates["means"] * 0.1**progress
            if step % len(shots) == 0:
                order = torch.randperm(len(shots)).tolist()
            shot = shots[order[step % len(shots)]]
            if backward(_loss(_gaussians(tables), shot, background, progress), optimizer):
                optimizer.step()
            step += 1
            if step % STEPS_PER_MOVE == 0 and progress < MOVES_END:
                _move(tables, optimizer, most)
    say(f"{len(tables['means']):,} Gaussians after {step:,} steps")
    return _gaussians(tables).map(Tensor.detach)


def _gaussians(tables: dict[str, nn.Parameter]) -> Gaussians:
    count, width = tables["harmonics"].shape
    shaped = {**tables, "logits": tables["logits"][:, 0], "harmonics": tables["harmonics"].view(count, 3, width // 3)}
    return Gaussians(**shaped)


def _loss(gaussians: Gaussians, shot: Shot, background: Tensor, progress: float) -> Tensor:
    """Return the difference () of Gaussians and a picture, over a random colour where the background is seen."""
    behind = torch.rand_like(background) if bool(shot.through.any()) else background
    target = shot.rgb + shot.through * behind
    rgb = draw(gaussians, shot.camera, behind, min(int(2 * (MAX_DEGREE + 1) * progress), MAX_DEGREE))
    loss = (1 - SSIM_WEIGHT) * (rgb - target).abs().mean()
    return loss if min(rgb.shape[:2]) < 11 else loss + SSIM_WEIGHT * (1 - ssim(rgb, target))


@torch.no_grad()
def _move(tables: dict[str, nn.Parameter], optimizer: Adam, most: int) -> None:
    """Move Gaussians that have become transparent, and add some."""
    here = len(tables["means"])
    change = moved(_gaussians(tables).map(Tensor.detach), max(min(most, int(GROWTH * here)) - here, 0))
    if change is None:
        return
    kept, fresh = change
    for name, values in vars(fresh).items():
        optimizer.change_rows(RowChange(tables[name], kept, values.reshape(len(fresh), -1)))
