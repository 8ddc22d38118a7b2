"""NeRF in the Wild: light that differs between photographs, and people and things that are in one of them only.

Martin-Brualla et al., "NeRF in the Wild: Neural Radiance Fields for Unconstrained Photo Collections", CVPR 2021. Each
training image has an appearance vector, an input of the static colours, and a transient vector, from which a second
head makes density, colour and uncertainty that exist in that image alone. Where an image disagrees with the others,
to say so costs less than to change the scene. Views that are no training images show the static part alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from nerfloom import Decision, Field, Method, Picture, Rays, Rendered, Sampler, Samples, Scene, View
from nerfloom.base.config import AT_LEAST_0, AUTO, AppearanceConfig, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.optimised import Optimised
from nerfloom.data.dataset import Dataset
from nerfloom.encodings.hash_grid import HashGrid, HashGridConfig
from nerfloom.fields.appearance import LIGHT_REASONS, Appearance
from nerfloom.fields.base import MLP
from nerfloom.fields.encoded import NUM_FEATURES, EncodedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.table_memory import require
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.losses.terms import KNOWN_DISTANCES, Distortion, SamplerLoss
from nerfloom.methods._captures import CaptureConfig, RefinedModel, decide_capture
from nerfloom.rendering.outputs import Output
from nerfloom.rendering.volume import VolumeRenderer, scaled_up_to, volume_render
from nerfloom.samplers.choice import contracted_box, decide_samples, make_sampler
from nerfloom.samplers.proposal import half_edge

APPEARANCE_SIZE = 48
"""Default length of appearance vectors if the appearance varies."""
PAPER_WIDTH, GRID_WIDTH = 256, 64
"""Features of a hidden layer, of the paper's networks and of those on a hash grid. The heads of the first have half."""
PAPER_RATE = 0.05
"""Learning rate of the paper's networks, relative to that of a hash grid: 5e-4 by default."""
FREQUENCIES = 6
"""Number of frequencies of positions for the transient head, whose features need not tell where they are."""
START = 0.2
"""Transient density before training, per half edge of the box."""
SAMPLES = 2**15
"""Samples per training step with an occupancy grid over a box."""
STATIC = Output("static", "color", of_training=True)
TRANSIENT = Output("transient", "color", of_training=True)
UNCERTAINTY = Output("uncertainty", "scalar", of_training=True)


@dataclass(frozen=True)
class NerfWConfig(
    HashGridConfig,
    CaptureConfig,
    AppearanceConfig,
    max_num_iterations=30_000,
    num_rays_per_batch=2_048,
    learning_rate=1e-2,
    lr_schedule="hold-exponential",
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-15,
    eval_num_rays_per_chunk=4_096,
):
    """Settings of nerf-w; open ones depend on the scene."""

    RANGES: ClassVar[dict[str, Range]] = {
        "appearance_embedding_dim": (0, 2**10),
        "transient_embedding_dim": (1, 2**10),
        "transient_resolution": (1, 2**8),
        "least_uncertainty": (1e-4, 1e4),
        "transient_density_mult": AT_LEAST_0,
    }
    """Allowed range of each numeric setting."""
    encoding: Literal["hash-grid", "frequency"] = "hash-grid"
    """hash-grid: small networks on a hash grid. frequency: the paper's networks, of 8 layers of 256 features."""
    appearance_embedding_dim: Auto[int] = AUTO
    """Length of each image's appearance vector. auto: 48, as in the paper, if light or exposure differ between images,
    otherwise 0."""
    transient_embedding_dim: int = 16
    """Length of an image's transient vectors."""
    transient_resolution: int = 16
    """Vectors along each side of an image, between which they are interpolated; 1 in the paper: one for each image."""
    least_uncertainty: float = 0.1
    """Standard deviation of colours where nothing is transient; 0.03 in the paper."""
    transient_density_mult: float = 0.01
    """Weight of the mean transient density, per half edge of the box."""
    bounded_sampler = "proposal"


class TransientHead(nn.Module):
    """Density, colour and uncertainty that one image has alone: NeRF-W, equation 10.

    Each image has a map of vectors, interpolated between the vertices of a square grid over it. A map of one vertex is
    the paper's transient vector.

    Args:
        num_features: number F of features of the field.
        size: length S of a vector.
        resolution: vertices along each side of an image's map.
        width: features of a hidden layer.
        box: (2, 3) corners of the box, scene units.
        camera_to_worlds: (M, 3, 4) poses of the training cameras.
    """

    box: Tensor
    turns: Tensor
    reach: Tensor

    def __init__(
        self, num_features: int, size: int, resolution: int, width: int, box: Tensor, camera_to_worlds: Tensor
    ) -> None:
        super().__init__()
        require(4.0 * len(camera_to_worlds) * resolution**2 * size, "the transient vectors of all images")
        self.resolution = resolution
        self.vectors = nn.Parameter(torch.zeros(len(camera_to_worlds) * resolution**2, size))
        self.network = MLP(num_features + size + 3 + 6 * FREQUENCIES, width, width, 5)
        self.register_buffer("box", box.clone())
        self.register_buffer("turns", camera_to_worlds[:, :, :3].clone())
        self.register_buffer("reach", torch.ones(()))  # tangent of the widest angle between a ray and its camera's axis
        self.start = START / half_edge(box)
        self.shown_image: int | None = None
        """Training image whose transient part is rendered outside of training; None for none."""

    def forward(self, features: Tensor, positions: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return transient density (N,), 1/length, colour (N, 3) in [0, 1], and uncertainty (N,), all of float32.

        Args:
            features: (N, F) features of the field.
            positions: (N, 3) scene coordinates.
            vectors: (N, S) vector of each sample's image where its ray crosses the image.
        """
        placed = frequency_encoding(2 * contract_to_unit(positions, self.box) - 1, FREQUENCIES)
        density, found = self.network.density(features, vectors.to(features.dtype), placed.to(features.dtype))
        return self.start * density, found[:, 1:4].float().sigmoid(), functional.softplus(found[:, 4].float())

    def vectors_of(self, rays: Rays) -> Tensor | None:
        """Return the vector (R, S) of each ray's image where the ray crosses it; None for rays of no training image."""
        images = rays.camera_indices
        if images is None and self.shown_image is not None:
            images = torch.full((len(rays),), self.shown_image, device=rays.origins.device)
        if images is None:
            return None
        local = torch.einsum("rij,ri->rj", self.turns.to(rays.directions)[images], rays.directions.detach())
        across = local[:, :2] / (local[:, 2:].neg().clamp(min=1e-3) * self.reach)  # -1 and 1 at the edges
        place = (across.clamp(-1, 1) + 1) / 2 * (self.resolution - 1)
        low = place.floor().clamp(max=max(self.resolution - 2, 0))
        share, total = place - low, torch.zeros((), device=place.device)
        for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            column, row = ((low[:, k] + s).clamp(max=self.resolution - 1).long() for k, s in ((0, x), (1, y)))
            weight = (share[:, 0] if x else 1 - share[:, 0]) * (share[:, 1] if y else 1 - share[:, 1])
            vertex = (images * self.resolution + row) * self.resolution + column
            total = total + weight[:, None].to(self.vectors) * functional.embedding(vertex, self.vectors)
        return total


class WildRenderer(VolumeRenderer):
    """Volume rendering of the static field alone, and together with the transient part of the rays' images.

    In an interval where both have density, each emits light in proportion to it. This is the integral of equation 3 for
    constant densities. The paper's equation 8 adds the opacities of both instead, which is the same for thin intervals.

    Depth, opacity and weights are those of the static part. The uncertainty is composited by the transient density
    alone (equation 11), so that the static part does not change on its account.

    Args:
        head: the transient part.
        least: uncertainty where nothing is transient.
        unit_length: gradients are scaled within this distance from the camera, scene units; None for no scaling.
    """

    outputs = (STATIC, TRANSIENT, UNCERTAINTY)

    def __init__(self, head: TransientHead, least: float, unit_length: float | None) -> None:
        super().__init__(unit_length)
        self.head, self.least = head, least

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        sigma, rgb = self.values(rays, samples, field)
        static = volume_render(rays, samples, sigma, rgb, background)
        vectors, extras = self.head.vectors_of(rays), {STATIC.name: static.rgb}
        if vectors is None:
            nothing = {
                TRANSIENT.name: torch.zeros_like(static.rgb),
                UNCERTAINTY.name: static.accumulation.new_full((len(rays),), self.least),
            }
            return replace(static, extras=extras | nothing)
        assert samples.features is not None
        density, color, doubt = self.head(
            samples.features, samples.positions(rays).detach(), vectors.index_select(0, samples.ray_indices)
        )
        share = (density / (sigma + density).clamp(min=torch.finfo(torch.float32).tiny))[:, None]
        both = volume_render(rays, samples, sigma + density, torch.lerp(rgb, color, share), background)
        assert both.weights is not None
        extras[TRANSIENT.name] = ray_sum((both.weights[:, None] * share * color).detach(), samples)
        nothing_behind, doubts = torch.zeros_like(background), doubt[:, None].expand(-1, 3)
        extras[UNCERTAINTY.name] = self.least + volume_render(rays, samples, density, doubts, nothing_behind).rgb[:, 0]
        extras["transient_density"] = ray_sum(density, samples) / samples.counts.clamp(min=1)
        return replace(static, rgb=both.rgb, extras=extras)


def doubted_error(rgb: Tensor, true: Tensor, doubt: Tensor, least: float, weights: Tensor | None = None) -> Tensor:
    """Return the error () of colours in units of their uncertainty, which must not be large: NeRF-W, equation 13.

    It is the negative logarithm of a normal distribution, mean(e^2 / (2 doubt^2) + log(doubt / least)), times
    2 least^2, so that it is the mean squared error where the uncertainty is least.

    Args:
        rgb: (P, 3) rendered colours.
        true: (P, 3) true colours.
        doubt: (P,) standard deviation of each pixel's colour.
        least: the least standard deviation.
        weights: (P,) factor of each pixel; None for 1.
    """
    if not len(rgb):
        return rgb.sum()
    ratio = doubt / least
    each = (rgb - true).square().mean(-1) / ratio.square() + 2 * least**2 * ratio.log()
    return (each if weights is None else each * weights).mean()


class DoubtedError(LossTerm):
    """Error of colours in units of their uncertainty."""

    def __init__(self) -> None:
        super().__init__("rgb")

    def __call__(self, shown: RenderedBatch) -> Tensor:
        pixels, batch = shown.pixels, shown.batch
        least = shown.model.config.least_uncertainty
        return doubted_error(pixels.rgb, batch.rgb, pixels.extras[UNCERTAINTY.name], least, shown.weights)


class TransientDensity(LossTerm):
    """Mean transient density, per half edge of the box: NeRF-W, equation 13, in the unit of `doubted_error`."""

    def __init__(self) -> None:
        super().__init__("transient", "transient_density_mult")

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        density = shown.rendered.extras["transient_density"]
        unit = 2 * shown.model.config.least_uncertainty**2 * half_edge(shown.model.scene.box)
        return unit * density.mean() if len(density) else None


class NerfW(RefinedModel[NerfWConfig], plain=True):
    """A model that believes images only as far as others agree with them."""

    losses = (DoubtedError(), TransientDensity(), SamplerLoss(), *KNOWN_DISTANCES, Distortion())
    renderer: WildRenderer

    @property
    def appearance(self) -> Appearance | None:
        """Appearance vectors of the training images; None if there are none."""
        return self.field.appearance if isinstance(self.field, (EncodedField, NeRFField)) else None

    def render_view(self, view: View, background: Tensor) -> Picture:
        with nullcontext() if view.image is None else self._showing(view.image):
            return super().render_view(view, background)

    def start(self, dataset: Dataset) -> None:
        """Lay the maps of transient vectors over the images.

        Args:
            dataset: the training images.
        """
        cameras = dataset.cameras
        half = torch.maximum(cameras.widths / cameras.fx, cameras.heights / cameras.fy) / 2
        self.renderer.head.reach.fill_(float(half.max()))

    @contextmanager
    def _showing(self, image: int) -> Iterator[None]:
        """Render with the appearance and the transient part of a training image, within a `with` block."""
        own, appearance = self.renderer.head, self.appearance
        own.shown_image = image
        try:
            with nullcontext() if appearance is None else appearance.shown(appearance.vectors[image].detach()):
                yield
        finally:
            own.shown_image = None


def decide(config: NerfWConfig, scene: Scene) -> tuple[NerfWConfig, list[Decision]]:
    """Fill in the settings that depend on the scene.

    Returns:
        Settings without open ones, and a record of each setting that was filled in.
    """
    config, scaled = fill(config, Choice("gradient_scaling", True, "what is near one camera may be in its image alone"))
    varies = scene.appearance_varies
    size = APPEARANCE_SIZE if varies else 0
    appearance = Choice("appearance_embedding_dim", size, LIGHT_REASONS[varies], "appearance features")
    config, made = decide_capture(config, scene, appearance)
    config, samples = decide_samples(config, SAMPLES)
    return config, scaled + made + samples


def make_field(config: NerfWConfig, scene: Scene) -> EncodedField | NeRFField:
    """Return the static field, with appearance vectors if their length is not 0."""
    size, appearance = config.appearance_embedding_dim, None
    if size:
        appearance = Appearance(size, scene.num_cameras, None, config.mean_appearance_share, config.eval_appearance)
    if config.encoding == "frequency":
        field = NeRFField(PAPER_WIDTH, contracted=contracted_box(config, scene), appearance=appearance)
        field.optimised = Optimised(learning_rate=PAPER_RATE * config.learning_rate)
        return field
    return EncodedField(
        scene.box, HashGrid.of(config, 0.0), GRID_WIDTH, unbounded=config.contraction, appearance=appearance
    )


def sampler(config: NerfWConfig, scene: Scene) -> Sampler:
    """Return the configured sampler, which knows the static density alone."""
    return make_sampler(config, replace(scene, unbounded=config.contraction))


def renderer(config: NerfWConfig, scene: Scene) -> WildRenderer:
    """Return the renderer, with the transient head."""
    features, width = (PAPER_WIDTH, PAPER_WIDTH // 2) if config.encoding == "frequency" else (NUM_FEATURES, GRID_WIDTH)
    poses = scene.camera_to_worlds
    if poses is None:
        poses = torch.eye(3, 4).repeat(scene.num_cameras, 1, 1)
    head = TransientHead(features, config.transient_embedding_dim, config.transient_resolution, width, scene.box, poses)
    return WildRenderer(head, config.least_uncertainty, scaled_up_to(config, scene))


METHOD = Method(
    NerfWConfig(),
    paper="arXiv:2008.02268",
    field=make_field,
    sampler=sampler,
    renderer=renderer,
    model=NerfW,
    decide=decide,
)
