"""Gaussians fitted to the pictures of a field, so that a method without Gaussians can be shown where only they can.

They start on the surfaces that the field's rays end on (`framework/export/points.py`), and gaussian-splatting trains
them with moves as in 3DGS-MCMC (Kheradmand et al. 2024). The field teaches them (`framework/training/taught.py`): they
learn from pictures that it renders between and around the training cameras. A field on a CPU renders few pictures per
minute, so half of the steps use photographs, if the field aims to reproduce photographs exactly: nothing moves, light
does not vary, and Gaussians can be drawn with the lens.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.device import seed_step
from nerfloom.base.errors import ConfigError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import ViewBatch, training_background
from nerfloom.data.sources import Request, ViewSource
from nerfloom.export.points import several_passes
from nerfloom.method import Method
from nerfloom.renderable import RendersRays
from nerfloom.splats.drawing import DRAWN
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians
from nerfloom.splats.learning import number_for, rate_factor
from nerfloom.splats.look import OURS
from nerfloom.splats.start import on_surfaces
from nerfloom.training.progress import take_all
from nerfloom.training.taught import MAX_SIDE, MixedSource, TaughtViews, random_part
from nerfloom.training.trainer import Trainer

PICTURES_SHARE = 0.45
"""Share of the budget for rendering pictures; the rest is for training steps."""
FIELD_SHARE = 0.5
"""Share of the field's steps beside those of photographs. It does not fall: Gaussians have to look like the field."""
UNSEEN_EVERY = 4
"""Every Nth picture is from an unseen pose, the others from training cameras."""
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
}
"""Settings of gaussian-splatting for learning a field's pictures; data and budget set the others."""


class PartsOfPhotographs(ViewSource):
    """Draws a random part of each photograph, with a longer side of at most MAX_SIDE pixels, to learn its colours."""

    def draw(self, request: Request) -> ViewBatch:
        whole = super().draw(request)
        camera, here = random_part(whole.view.camera, MAX_SIDE)
        weights = None if whole.weights is None else whole.weights[here]
        return ViewBatch(whole.index, View(camera), whole.rgb[here], whole.background, weights=weights)


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
    # Colours alone are learnt.
    dataset = replace(dataset, scene=replace(dataset.scene, num_scenes=1), depths=None, sparse_depth=None)
    drawable = replace(dataset, cameras=cameras)
    background = training_background("auto", dataset.scene)
    pictures = TaughtViews(model.render_view, drawable, background, machine.seed, UNSEEN_EVERY)
    pictures.render_ahead(PICTURES_SHARE * seconds)
    exact = dataset.times is None and dataset.cameras.model in DRAWN and not dataset.scene.appearance_varies
    train_set, share, used = (dataset, FIELD_SHARE, len(dataset)) if exact else (drawable, 1.0, 0)
    counts = f"{pictures.count} pictures of the field and {used} photographs"
    say(f"learning from {counts}; {len(points):,} points on surfaces")
    own_share = (1 - PICTURES_SHARE) * seconds
    settings: Any = splatting.config
    config = replace(
        settings,
        **SETTINGS,
        background=background,
        # On a slow machine even the fewest pictures exceed their share; training still needs time.
        max_seconds=max(seconds - (time.perf_counter() - begun), own_share),
        num_gaussians=most,
        rate_factor=rate_factor(STEPS_PER_SECOND * own_share, MAX_RATE),
        machine=machine,
    )
    photographs = PartsOfPhotographs(train_set, background, machine.seed)
    trainer = Trainer(splatting, config, train_set, source=MixedSource(photographs, pictures, share, until=math.inf))
    trainer.prepare(start=False)
    fitted: Any = trainer.model
    fitted.set_gaussians(on_surfaces(points, colors, MAX_DEGREE))
    take_all(trainer.steps(), "Fitting Gaussians")
    found, dropped = fitted.gaussians(), trainer.state.skipped
    without = f" ({dropped:,} dropped: gradients not finite)" if dropped else ""
    say(f"{counted(len(found), 'Gaussians')} after {counted(trainer.state.step, 'steps')}{without}")
    return found
