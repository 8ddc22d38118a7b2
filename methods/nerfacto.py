"""Nerfacto: hash grid, contraction and proposal sampling for real captures; other parts depend on the data.

Tancik et al., "Nerfstudio: A Modular Framework for Neural Radiance Field Development", SIGGRAPH 2023, section 4. Its
parts: hash grid (Mueller et al. 2022); contraction, proposals and distortion loss (Barron et al. 2022); appearance
vectors (Martin-Brualla et al. 2021); gradients scaled near cameras (Philip and Deschaintre 2023).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

from torch import Tensor

from nerfloom import (
    ConfigError,
    Decision,
    Field,
    Method,
    PixelBatch,
    Points,
    RayModel,
    Rays,
    Rendered,
    Renderer,
    Sampler,
    Samples,
    Scene,
)
from nerfloom.base.config import AUTO, Range, VectorConfig
from nerfloom.base.decisions import Choice, fill
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.appearance import make_vectors
from nerfloom.fields.directional import DensityDirectionalConfig, reflection_of
from nerfloom.fields.encoded import NUM_FEATURES, EncodedField
from nerfloom.fields.normals import NormalHead, density_normals, normal_penalties
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.losses.few_images import FewImagesConfig, decide_few_images
from nerfloom.losses.normals import PREDICTED_NORMALS, NormalPenalty
from nerfloom.losses.terms import COLOR_ERROR, FEW_IMAGES, KNOWN_DISTANCES, Distortion, SamplerLoss
from nerfloom.methods._captures import MARCHED_SAMPLES, CaptureConfig, RefinedModel, decide_capture
from nerfloom.rendering.choice import volume_renderer
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.volume import VolumeRenderer, scaled_up_to
from nerfloom.samplers.choice import batch_choice, make_sampler

MIN_SAMPLES, MIN_SAMPLES_SECONDS = 2**15, 150.0
"""Minimum samples per training step with an occupancy grid over a box, used up to this many seconds on two threads."""
THIN = 0.5
"""Samples are thinned below this fraction of the mean gradient: 1.1 times the steps, with the same PSNR in 45 s."""


@dataclass(frozen=True)
class NerfactoConfig(
    CaptureConfig,
    FewImagesConfig,
    VectorConfig,
    DensityDirectionalConfig,
    max_num_iterations=30_000,
    thin_gradients=AUTO,
):
    """Settings of nerfacto; open ones depend on the scene."""

    RANGES: ClassVar[dict[str, Range]] = {"hidden_width": (1, 2**14)}
    predict_normals: bool = False
    """Whether to predict normals, which are smoother than normals from the density's gradient. --directional reflected
    always does."""
    hidden_width: int = 64
    """Features per hidden layer of the two networks."""


class NormalRenderer(VolumeRenderer):
    """Volume rendering with predicted normals and, in training, their penalties.

    Args:
        normals: the network that predicts normals.
        unit_length: gradients are scaled within this distance from the camera, scene units; None for no scaling.
        thin: samples are thinned below this fraction of the mean gradient; 0 for none.
    """

    outputs = (NORMALS,)

    def __init__(self, normals: NormalHead, unit_length: float | None, thin: float = 0.0) -> None:
        super().__init__(unit_length, thin)
        self.normals = normals

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().shade(rays, samples, field, background)
        assert isinstance(field, EncodedField)
        assert samples.features is not None
        assert rendered.weights is not None
        points, weights = Points(samples.positions(rays).detach(), samples.times(rays)), rendered.weights
        predicted = self.normals(samples.features.detach(), 2 * field.unit(points.positions) - 1)
        facing = {NORMALS.name: ray_sum(weights.detach()[:, None] * predicted, samples)}
        if not self.training:
            return replace(rendered, extras={**rendered.extras, **facing})
        target = density_normals(field, points)
        directions = rays.directions.detach().index_select(0, samples.ray_indices)
        penalties = normal_penalties(predicted, target, directions, weights, samples)
        return replace(rendered, extras={**rendered.extras, **facing, **penalties})


class IfPredicted(NormalPenalty):
    """A penalty on predicted normals, if there are any."""

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return model.config.predict_normals


class Nerfacto(RefinedModel[NerfactoConfig], plain=True):
    """A model with appearance vectors, refined poses, and the penalties of predicted normals."""

    losses = (
        COLOR_ERROR,
        SamplerLoss(),
        *KNOWN_DISTANCES,
        Distortion(),
        IfPredicted("normals"),
        IfPredicted("orientation", "orientation_loss_mult"),
        *FEW_IMAGES,
        PREDICTED_NORMALS,
    )
    steps_repeat = True


def decide(config: NerfactoConfig, scene: Scene) -> tuple[NerfactoConfig, list[Decision]]:
    """Fill in the settings that depend on the scene.

    Raises:
        ConfigError: if normals are to be predicted twice.
    """
    if config.predict_normals and config.directional == "reflected":
        raise ConfigError("--directional reflected predicts normals already; leave out --predict-normals")
    config, made = decide_capture(config, scene)
    if config.sampler == "occupancy" and not config.contraction:
        config, samples = fill(config, batch_choice(config, MIN_SAMPLES, MARCHED_SAMPLES, MIN_SAMPLES_SECONDS))
        reason = "most samples of an occupancy grid have small gradients"
        config, thinned = fill(config, Choice("thin_gradients", THIN, reason, "gradients thinned, of the mean"))
        made += samples + thinned
    else:
        config, _ = fill(config, Choice("thin_gradients", 0.0, "proposals choose samples that matter"))
    config, few = decide_few_images(config, scene)
    return config, made + few


def make_field(config: NerfactoConfig, scene: Scene) -> EncodedField:
    """Return a field of one hash grid and two small networks, with appearance vectors if the settings have them."""
    opening, appearance = config.open_levels_until, make_vectors(config, scene)
    size = 0 if appearance is None else appearance.size
    return EncodedField(
        scene.box,
        HashGrid.of(config, opening),
        config.hidden_width,
        unbounded=config.contraction,
        appearance=appearance,
        opening=opening,
        reflection=reflection_of(config, config.hidden_width, more=size),
    )


def sampler(config: NerfactoConfig, scene: Scene) -> Sampler:
    """Return the configured sampler; it covers all of space if that is contracted."""
    return make_sampler(config, replace(scene, unbounded=config.contraction))


def renderer(config: NerfactoConfig, scene: Scene) -> Renderer:
    """Return the renderer, with gradient scaling and predicted normals as configured."""
    if not config.predict_normals:
        return volume_renderer(config, scene)
    normals = NormalHead(NUM_FEATURES, config.hidden_width)
    return NormalRenderer(normals, scaled_up_to(config, scene), config.thin_gradients)


METHOD = Method(
    NerfactoConfig(),
    paper="arXiv:2302.04264",
    field=make_field,
    sampler=sampler,
    renderer=renderer,
    model=Nerfacto,
    decide=decide,
)
