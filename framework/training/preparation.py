"""Preparation of training: decided settings, the scene's profile, and space known to be empty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say
from nerfloom.base.decisions import Decision
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.ndc import NdcCameras
from nerfloom.cameras.upright import sideways_up
from nerfloom.data.dataset import Dataset, cuts_out
from nerfloom.data.pixels.batch import training_background
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.scene import Scene
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.method import Method
from nerfloom.model import LearnsMotion, Model
from nerfloom.ray_model import RayModel
from nerfloom.renderable import RefinesPoses, RendersFromImages, parts
from nerfloom.samplers.base import Carved, SkipsCells
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.scene.folded_poses import angle_between, folded_neighbours, thumbnail
from nerfloom.scene.moving_hulls import moving_box, moving_hulls
from nerfloom.scene.profile import SceneProfile
from nerfloom.scene.seen_cells import seen_cells
from nerfloom.scene.silhouettes import Silhouettes, pixels_near, visual_hull
from nerfloom.scene.speed import MIN_IMAGES, MIN_TIMES, motion_bound
from nerfloom.training.ray_starts import nearest_shown, starts_checked
from nerfloom.training.robust_choice import robust_chosen
from nerfloom.training.speed import with_speed


def decided(method: Method, config: Any, dataset: Dataset) -> tuple[Dataset, TrainConfig, list[Decision]]:
    """Decide the settings that a method leaves to the data, and the box of a moving scene.

    A method that learns motion and samples with an occupancy grid gets the smallest box that the silhouettes allow.

    Args:
        config: the run's settings.
        dataset: the training images.

    Returns:
        The data set, possibly with a smaller box; the settings; and each decision with its reason.

    Raises:
        ConfigError: if the method cannot draw the images' cameras, or a scout cannot learn the method's scene.
    """
    _check_cameras(method.name, method.model.cameras, dataset)
    _check_scout(method, config, dataset.scene)
    config, measured = with_speed(config)
    config, left_out = robust_chosen(config, dataset)
    measured = measured + left_out
    settings, made = method.decided(config, dataset.scene)
    made = measured + made
    settings, made = starts_checked(config, settings, made, dataset)
    times = dataset.times
    looks = settings.sampler == "occupancy" and (settings.smallest_box or settings.silhouette_cells)
    if times is None or not looks or dataset.scene.unbounded or _no_silhouettes(dataset) is not None:
        return dataset, settings, made
    silhouettes, old = Silhouettes.of(dataset), dataset.scene.box.cpu()
    bound = motion_bound(silhouettes, old, times)
    if bound is None:
        return dataset, settings, made
    dataset = replace(dataset, motion_bound=bound)
    edges = f"at most {bound.fastest / float((old[1] - old[0]).max()):.2g} of the box's longest edge in all time"
    found = [Decision("motion", edges, "slower matter could not be where alpha shows some")]
    if settings.smallest_box:
        box = moving_box(silhouettes, old, times, bound)
        share = float(((box[1] - box[0]) / (old[1] - old[0])).prod())
        shorter = float((box[1] - box[0]).norm() / (old[1] - old[0]).norm())
        default: Any = method.config
        if config.num_steps == default.num_steps:  # the steps stay as long
            config = replace(config, num_steps=max(round(settings.num_steps * shorter), 1))
        dataset = replace(dataset, scene=replace(dataset.scene, box=box.to(dataset.device)))
        settings, made = method.decided(config, dataset.scene)
        made = measured + made
        found.append(Decision("box", f"{100 * share:.0f}% of the data's", "alpha shows that nothing is ever outside"))
    return dataset, settings, [*found, *made]


def _check_cameras(method: str, drawn: tuple[str, ...] | None, dataset: Dataset) -> None:
    if drawn is None:
        return
    instead = "take a method that casts rays, such as nerfacto"
    if isinstance(dataset.cameras, NdcCameras):
        raise ConfigError(f"{method} cannot draw normalised device coordinates: leave out --ndc, or {instead}")
    if (model := dataset.cameras.model) not in drawn:
        raise ConfigError(
            f"{method} cannot draw {model} cameras, only {', '.join(drawn)}; convert the images to these first,"
            f" or {instead}"
        )


def _check_scout(method: Method, config: TrainConfig, scene: Scene) -> None:
    if config.robust != "scout":
        return
    if scene.num_scenes > 1:
        raise ConfigError("--robust scout: its field learns one scene, and here are several; use --robust errors")
    if scene.moving and issubclass(method.model, LearnsMotion):
        raise ConfigError(f"--robust scout: what moves would be left out, and {method.name} learns it; use errors")


def profile_of(
    method: str, config: TrainConfig, model: Model[Any], dataset: Dataset, decided: Sequence[Decision]
) -> SceneProfile:
    """Return the profile of the scene in `dataset`, with the decisions `decided` for a `method` and their reasons."""
    scene, decisions = model.scene, []
    if dataset.opaque is not None and config.masks == "auto":
        cut = cuts_out(dataset.opaque, dataset.cameras)
        reason = f"they {'remove over half of the pixels, and differ between photographs' if cut else 'show an object'}"
        decisions.append(Decision("masks", "masked-out pixels are empty", f"{reason} (else: --masks ignored or off)"))
    if config.background == "auto":
        reason = "every ray ends in the box" if scene.ends_in_box else "no photograph has alpha"
        reason = "the photographs have alpha" if scene.has_alpha else reason
        decisions.append(Decision("background", training_background(config.background, scene), reason))
    if config.silhouette_cells and parts(model, Carved):
        obstacle = _no_hull(dataset)
        outside = "what is outside all of them" if scene.moving else "space outside them"
        choice = "not used" if obstacle else f"{outside} is skipped from the start"
        decisions.append(Decision("silhouettes", choice, obstacle or "alpha shows them"))
    if isinstance(model, RayModel) and model.covisible_space is not None:
        where = f"where at least {config.rays_shared_by} photographs look"
        reason = "what one shows could be at any distance (else: --rays-shared-by 0)"
        decisions.append(Decision("rays start", where, reason))
    if scene.moving and not isinstance(model, LearnsMotion):
        decisions.append(Decision("times", "ignored", f"{method} learns a still scene: moving objects are blurred"))
    if scene.appearance_varies and config.changing_light == config.appearance == "none":
        decisions.append(Decision("light that differs", "ignored", f"{method} learns one light for all photographs"))
    up = None if scene.poses != "photographs" or scene.num_scenes > 1 else sideways_up(dataset.cameras.camera_to_worlds)
    if up is not None and float(up[2]) > 0.9:
        decisions.append(
            Decision("up", "their left or right", "the photographs lie on their side (else: --orientation-method up)")
        )
    if scene.poses == "photographs" and not scene.moving and scene.num_scenes == 1:
        decisions += _warning_of_folds(dataset)
    if scene.poses == "device" and not isinstance(model, RefinesPoses):
        decisions.append(Decision("the device's poses", "not refined", f"{method} takes poses as they are"))
    return SceneProfile.of(dataset, [*decisions, *decided])


def _warning_of_folds(dataset: Dataset) -> list[Decision]:
    """Return a warning if a repeated structure seems to have folded the reconstruction."""
    ahead = -dataset.cameras.camera_to_worlds[:, :, 2].cpu().numpy()
    thumbnails = np.stack([thumbnail(dataset.image(index).cpu().numpy()) for index in range(len(dataset))])
    pairs = folded_neighbours(dataset.names, ahead, thumbnails)
    if not pairs:
        return []
    first, second = pairs[0]
    reason = (
        f"{dataset.names[first]} and {dataset.names[second]} look alike, but their cameras look "
        f"{angle_between(ahead[first], ahead[second]):.0f} degrees apart (such pairs: {len(pairs)}): something that "
        "repeats, like a label printed twice, was matched as one. ns-process-data finds poses without the fold, "
        "if enough photographs lie between these two"
    )
    return [Decision("warning, poses", "they seem to be folded", reason)]


def show_images(model: Model[Any], train_set: Dataset, eval_set: Dataset | None) -> None:
    """Give `train_set`, and source images of held-out scenes in `eval_set`, to a model that renders from images."""
    if isinstance(model, RendersFromImages):
        model.show_images(train_set)
        if eval_set is not None and eval_set.source_images is not None:
            model.show_images(eval_set)


def skip_empty(config: TrainConfig, model: Model[Any], dataset: Dataset, fresh: bool) -> Dataset:
    """Empty the cells of grids that silhouettes exclude or that no training image shows.

    Args:
        model: the model; its parts hold the grids.
        dataset: the training images.
        fresh: whether training starts; if not, the grids come from a checkpoint and are not changed.

    Returns:
        The data set, without pixels if their rays meet only emptied cells.
    """
    dataset = skip_by_silhouettes(config, model, dataset, fresh)
    if dataset.motion_bound is not None:
        for sampler in parts(model, OccupancySampler):
            sampler.expect_motion(dataset.motion_bound.in_a_slice(sampler.slices))
    if fresh:
        skip_unseen(config, model, dataset)
        if isinstance(model, RayModel) and model.covisible_space is not None:
            model.covisible_space.exclude(dataset.cameras, nearest_shown(dataset), config.rays_shared_by)
    return dataset


def skip_unseen(config: TrainConfig, model: Model[Any], dataset: Dataset) -> None:
    """Empty the cells of nested boxes that no training image shows, or only in front of everything it shows.

    `config`, `model` and `dataset` are as in `skip_empty`.
    """
    nested = [sampler for sampler in parts(model, SkipsCells) if sampler.levels > 1]
    if not nested or not config.seen_cells:
        return
    cameras, nearest = dataset.cameras, nearest_shown(dataset)
    for sampler in nested:
        boxes = nested_boxes(sampler.box, sampler.levels)
        seen = torch.cat([seen_cells(cameras, nearest, box, sampler.resolution) for box in boxes])
        sampler.carve(seen & ~sampler.carved)


def skip_by_silhouettes(config: TrainConfig, model: Model[Any], dataset: Dataset, fresh: bool) -> Dataset:
    """Empty the cells of grids that are outside the images' silhouettes.

    `config`, `model`, `dataset`, `fresh` and the result are as in `skip_empty`.
    """
    grids = parts(model, Carved)
    if not grids or not config.silhouette_cells or _no_hull(dataset) is not None:
        return dataset
    silhouettes, moving = Silhouettes.of(dataset), model.scene.moving
    if fresh:
        hulls = [_hull(silhouettes, grid, dataset) for grid in grids]
        if not all(bool(hull.any()) for hull in hulls):
            say("warning: the photographs' alpha leaves no part of the box; it is not used to skip anything")
            return dataset
        for grid, hull in zip(grids, hulls, strict=True):
            grid.carve(hull)
    # In a moving scene, a pixel that is empty at its time supervises cells that are occupied at other times.
    if moving or not all(bool(grid.carved.any()) for grid in grids):
        return dataset
    near = [
        pixels_near(silhouettes, kept, box, grid.resolution)
        for grid in grids
        for kept, box in zip(
            (~grid.carved).view(grid.levels, -1).cpu(), nested_boxes(grid.box.cpu(), grid.levels), strict=True
        )
    ]
    return dataset.drawing(PixelSet.shared(near, 1))


def _hull(silhouettes: Silhouettes, grid: Carved, dataset: Dataset) -> Tensor:
    """Return the cells of `grid` that the `silhouettes` of `dataset` do not exclude."""
    boxes, n, times, bound = (
        nested_boxes(grid.box.cpu(), grid.levels),
        grid.resolution,
        dataset.times,
        dataset.motion_bound,
    )
    if times is None or bound is None:
        hulls = [visual_hull(silhouettes, box, n) for box in boxes]
    else:
        hulls = [moving_hulls(silhouettes, box, n, times, bound, grid.slices) for box in boxes]
    return torch.cat(hulls).to(grid.box.device)


def _no_silhouettes(dataset: Dataset) -> str | None:
    """Return why the images' alpha cannot show empty space; None if it can."""
    if not dataset.scene.has_alpha:
        return "no photograph has alpha"
    if isinstance(dataset.cameras, NdcCameras):
        return "the box is in normalised device coordinates"
    camera = dataset.cameras.model
    return None if camera == "pinhole" else f"the camera is {camera}, not pinhole"


def _no_hull(dataset: Dataset) -> str | None:
    """Return why the images' alpha cannot empty cells; None if it can."""
    obstacle = _no_silhouettes(dataset)
    if obstacle is not None or dataset.times is None or dataset.motion_bound is not None:
        return obstacle
    if dataset.scene.unbounded:
        return "the speed of motion can only be found in a bounded scene"
    few = f"{len(dataset)} images at {len(dataset.times.unique())} times"
    return f"{few} are too few to tell how fast something moves: it takes {MIN_IMAGES} at {MIN_TIMES} times"
