"""Settings and model shared by methods that learn a signed distance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, Literal, TypeVar

import torch
from torch import Tensor

from nerfloom import ConfigError, Decision, Points, Rays, Rendered, Samples, Scene
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range, VectorConfig
from nerfloom.base.console import say
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.device import HostValue
from nerfloom.data.dataset import Dataset
from nerfloom.encodings.hash_grid import HashGrid, HashGridConfig
from nerfloom.fields.appearance import make_vectors
from nerfloom.fields.base import DensityFunction, Field
from nerfloom.fields.directional import NUM_PROPERTIES, DirectionalConfig, reflection_of
from nerfloom.fields.distance import Distance, GridDistance, NetworkDistance
from nerfloom.fields.inverted import InvertedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.fields.surface import Sharpness, SurfaceField
from nerfloom.geometry.floor import find_floor
from nerfloom.kernels.compositing.alpha import composite_alpha
from nerfloom.kernels.compositing.density import Composited, composite
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES
from nerfloom.kernels.surfaces.samples import unit_normals
from nerfloom.losses.surfaces import (
    Curvature,
    DistanceBounds,
    Eikonal,
    HiddenSpace,
    Silhouette,
    SurfacePoints,
)
from nerfloom.losses.terms import KNOWN_DISTANCES, ColorError, SamplerLoss
from nerfloom.methods._captures import RefinedConfig, RefinedModel, refinement_choice
from nerfloom.methods._grids import finest_cells, table_of_surface
from nerfloom.renderable import parts
from nerfloom.rendering.background import background_renderer
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.reflections import ReflectionRenderer
from nerfloom.rendering.renderer import Renderer
from nerfloom.rendering.volume import VolumeRenderer, scaled_up_to
from nerfloom.samplers.background import BackgroundConfig, decide_background, foreground, foreground_sphere
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.choice import decide_samples
from nerfloom.samplers.choice import make_sampler as occupancy_sampler
from nerfloom.samplers.evaluated_again import EvaluatedAgain
from nerfloom.samplers.first_crossing import FirstCrossing
from nerfloom.samplers.inside import inside_foreground
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.scene.hidden_cells import HiddenCells
from nerfloom.training.ray_starts import nearest_shown

SHARPER = 50.0
"""Upper bound of the inverse width just before the bound is lifted, relative to the first inverse width."""
SHARPNESS_RATE = 5e-3
"""Learning rate of a tenth of the logarithm of the inverse width. 1e-3 was worse (docs/notes/surfaces.md)."""
SAMPLES = {"hash-grid": 2**15, "frequency": 2**13}
"""Samples per training step with an occupancy grid."""
COLOR_LAYERS = 4
"""Hidden layers of the papers' colour network."""
LEAST_ON_FLOOR, FLOOR_TOLERANCE = 0.05, 0.01
"""Minimum share of a reconstruction's points in the sphere that lie on a floor, and their maximum distance from it,
radii of the sphere."""
LONGEST, EVERY = 4.0, 16
"""Maximum length of a training step, in steps of `num_steps`, and the number of training steps between its changes."""


@dataclass(frozen=True)
class SurfaceConfig(
    HashGridConfig,
    BackgroundConfig,
    RefinedConfig,
    VectorConfig,
    DirectionalConfig,
    max_num_iterations=20_000,
    learning_rate=AUTO,
    lr_schedule="hold-exponential",
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-15,
    eval_num_rays_per_chunk=8_192,
    thin_gradients=0.5,
    sphere_around="object",
):
    """Settings of a method that learns a signed distance."""

    samplers: ClassVar[tuple[str, ...]] = ("occupancy",)
    """Samplers that suit the method."""
    RANGES: ClassVar[dict[str, Range]] = {
        "hidden_width": (1, 2**14),
        "position_frequencies": (0, MAX_FREQUENCIES),
        "direction_frequencies": (0, MAX_FREQUENCIES),
        "eikonal_loss_mult": AT_LEAST_0,
        "silhouette_loss_mult": AT_LEAST_0,
        "points_loss_mult": AT_LEAST_0,
        "bounds_loss_mult": AT_LEAST_0,
        "hidden_loss_mult": AT_LEAST_0,
        "curvature_loss_mult": AT_LEAST_0,
        "start_radius": (1e-3, 1),
        "start_sharpness": (1e-3, 1e6),
        "sharpen_until": (0, 1),
        "step_widths": AT_LEAST_0,
        "open_levels_until": (0, 1),
    }
    GONE: ClassVar[dict[str, Any]] = {
        "sharpness_learning_rate": SHARPNESS_RATE,
        "color_loss": "squared",
        "curvature_from": 0.0,
        "curvature_until": 0.4,
    }
    encoding: Literal["hash-grid", "frequency"] = "hash-grid"
    """hash-grid: small networks on a hash grid. frequency: the papers' networks, of 8 layers for the distance and 4 for
    the colour, for GPUs."""
    learning_rate: Auto[float] = AUTO
    """Initial learning rate of Adam. auto: 0.01 on a hash grid, 0.0005 for the papers' networks."""
    max_resolution: Auto[int] = AUTO
    """Cells along an axis of the hash grid's finest level. auto: the next power of two that gives each pixel a cell."""
    log2_table_size: Auto[int] = AUTO
    """Base-2 logarithm of the maximum number of entries of a level. auto: 17 up to 512 finest cells along an axis,
    otherwise 19."""
    hidden_width: Auto[int] = AUTO
    """Features per hidden layer of the two networks. auto: 64 on a hash grid, 256 for the papers' networks."""
    position_frequencies: int = 6
    """Number of frequencies in the encoding of positions (frequency)."""
    direction_frequencies: int = 4
    """Number of frequencies in the encoding of directions (frequency)."""
    eikonal_loss_mult: float = 0.003
    """Weight of the term that keeps the distance's gradient at length 1."""
    silhouette_loss_mult: float = 0.01
    """Weight of the difference between opacity and the images' alpha."""
    points_loss_mult: float = 0.1
    """Weight of the distance at points of a reconstruction, where it should be 0."""
    bounds_loss_mult: float = 0.1
    """Weight of distances before such points that are negative, or larger than the distance to the point."""
    hidden_loss_mult: float = 0.1
    """Weight of positive distances where images look but no training ray arrives, below a floor or inside of things.
    Only with a background on a sphere, and with an occupancy grid."""
    curvature_loss_mult: float = 0.002
    """Weight of the change of normals along the surface, in the first 40 % of the budget: details come last."""
    start_radius: Auto[float] = AUTO
    """Radius of the ball that training starts from, in halves of the box's shortest edge. auto: 0.5 if there is a
    background, otherwise 0.25."""
    start_sharpness: float = 20.0
    """First inverse width of the surface; the width is in halves of the box's shortest edge."""
    step_widths: float = 2.0
    """Length of a training step in widths of the surface, limited to one to four steps of --num-steps. 0: one step."""
    eval_rendering: Literal["volume", "surface"] = "volume"
    """Rendering of pictures. volume: as in training; surface: the colour where a ray first meets the surface."""
    sharpen_until: float = 0.3
    """Fraction of the budget until the upper bound of the inverse width has risen, exponentially, to 50 times the first
    value."""
    open_levels_until: float = 0.3
    """Fraction of the budget until all levels of the hash grid are open, from coarse to fine (hash-grid)."""


SurfaceConfigT = TypeVar("SurfaceConfigT", bound=SurfaceConfig)
FieldT = TypeVar("FieldT", bound=SurfaceField)


def decide_surface(config: SurfaceConfigT, scene: Scene) -> tuple[SurfaceConfigT, list[Decision]]:
    """Fill in the settings that depend on the scene."""
    if config.background_model == "contraction":
        raise ConfigError("--background-model contraction: a signed distance is not contracted; take sphere or none")
    config, made = decide_background(config, scene, "sphere")
    if config.sampler not in config.samplers:
        raise ConfigError(f"--sampler {config.sampler}: take --sampler {' or '.join(config.samplers)}")
    config, samples = decide_samples(config, SAMPLES[config.encoding])
    on_grid, suits = config.encoding == "hash-grid", f"--encoding is {config.encoding}"
    config, _ = fill(
        config,
        Choice("learning_rate", 1e-2 if on_grid else 5e-4, suits),
        Choice("hidden_width", 64 if on_grid else 256, suits),
    )
    config, cells = fill(config, finest_cells(scene))
    config, _ = fill(config, table_of_surface(config.max_resolution))
    captured = config.background_model == "sphere"
    reason = "a background could explain what has no texture" if captured else "nothing is behind the surfaces"
    radius = Choice("start_radius", 0.5 if captured else 0.25, reason, "radius of the first ball")
    config, own = fill(config, radius, refinement_choice(scene, marched=False))
    return config, made + samples + (cells if on_grid else []) + own


def make_distance(config: SurfaceConfig, box: Tensor) -> Distance:
    """Return a distance that starts as a ball: a small network on a hash grid, or the papers' network.

    Args:
        box: (2, 3) corners of the box, scene units.
    """
    radius, width = config.start_radius, config.hidden_width
    if config.encoding == "frequency":
        return NetworkDistance(box, radius, width, num_frequencies=config.position_frequencies)
    return GridDistance(box, HashGrid.of(config, config.open_levels_until), radius, width)


def surface_field(
    kind: type[FieldT], config: SurfaceConfig, scene: Scene, sharpness: type[Sharpness] = Sharpness
) -> FieldT:
    """Return a field that starts as a ball.

    Args:
        kind: class of the field.
        sharpness: class of the learnt inverse width.
    """
    box = foreground(config, scene).box
    distance, large = make_distance(config, box), config.encoding == "frequency"
    appearance = make_vectors(config, scene)
    size = 0 if appearance is None else appearance.size
    return kind(
        box,
        distance,
        sharpness(config.start_sharpness / distance.size, SHARPNESS_RATE),
        config.hidden_width,
        COLOR_LAYERS if large else 1,
        color_bias=large,
        direction_frequencies=config.direction_frequencies if large else None,
        appearance=appearance,
        reflection=reflection_of(config, config.hidden_width, distance.num_features - NUM_PROPERTIES, size),
    )


class SurfaceRenderer(VolumeRenderer):
    """Volume rendering with the normals of the distance."""

    outputs = (NORMALS,)

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().shade(rays, samples, field, background)
        if self.training:  # no term of the objective uses them
            return rendered
        assert samples.features is not None
        # Composited like colours over black, in one compiled call: torch would add them to their rays one by one.
        normals = unit_normals(samples.features[:, :3].detach())
        over = composite if samples.alpha is None else composite_alpha
        stopping = samples.sigma if samples.alpha is None else samples.alpha
        assert stopping is not None
        sums: Composited = over(samples, stopping.detach(), normals, normals.new_zeros(3), rays.fars)
        return replace(rendered, extras={**rendered.extras, NORMALS.name: sums.color})


def make_sampler(config: SurfaceConfig, scene: Scene) -> Sampler:
    """Return the sampler. Pictures are traced if --eval-rendering is surface, and samples follow refined poses."""
    sampler = occupancy_sampler(config, foreground(config, scene))
    assert isinstance(sampler, OccupancySampler)
    chosen: Sampler = FirstCrossing(sampler, config.eval_rendering == "surface")
    if config.camera_optimizer != "off":
        chosen = EvaluatedAgain(chosen)
    return inside_foreground(config, scene, chosen)


def make_background(config: SurfaceConfig, scene: Scene) -> Field:
    """Return a field for the outside of the sphere."""
    if config.encoding == "frequency":
        return NeRFField(config.hidden_width, dims=4)
    return InvertedField(HashGrid.of(config), config.hidden_width)


def renderer(config: SurfaceConfig, scene: Scene) -> Renderer:
    """Return the renderer, with a background if the scene has one."""
    kind = ReflectionRenderer if config.directional == "reflected" else SurfaceRenderer
    shown = kind(scaled_up_to(config, scene), config.thin_gradients)
    return background_renderer(config, scene, make_background, shown)


class SurfaceModel(RefinedModel[SurfaceConfigT], Generic[SurfaceConfigT]):
    """A model that learns the distance to a surface, its colour, and the poses if asked for."""

    field: SurfaceField
    step_scale: Tensor
    losses = (
        ColorError(),
        SamplerLoss(),
        Silhouette(),
        Eikonal(),
        SurfacePoints(),
        DistanceBounds(),
        HiddenSpace(),
        Curvature(),
        *KNOWN_DISTANCES,
    )

    def __init__(
        self, config: SurfaceConfigT, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer
    ) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        # Meshes and crops cover the field's box.
        self.scene = replace(scene, box=foreground(config, scene).box)
        self.sphere = foreground_sphere(config, scene) if config.background_model == "sphere" else None
        edges = self.field.box[1] - self.field.box[0]
        self.field.cell = float((edges / config.grid_resolution).norm())
        self.register_buffer("step_scale", torch.tensor(1.0))
        self._step_scale = HostValue()
        grids, hides = parts(sampler, OccupancySampler), config.hidden_loss_mult > 0 and self.sphere is not None
        self.hidden = HiddenCells(grids[0].box) if grids and hides else None

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        if self.training and self.hidden is not None and rendered.samples is not None:
            samples = rendered.samples
            self.hidden.note(samples.positions(rays.detached()), samples.deltas.detach())
        return rendered

    def before_step(self, step: int, progress: float) -> None:
        super().before_step(step, progress)
        if self.hidden is not None:
            self.hidden.settle(step)
        self.field.progress, until = progress, self.config.sharpen_until
        self.field.sharpness.limit(SHARPER ** (progress / until) if progress < until else math.inf)
        for sampler in parts(self, OccupancySampler):
            if step % EVERY == 0:
                width = self.config.step_widths / float(self.field.sharpness().detach())
                scale = min(max(width / sampler.step_size, 1.0), LONGEST)
                self._step_scale.change(self.step_scale, round(scale * 64) / 64)
            sampler.stride = self._step_scale.of(self.step_scale)

    def start(self, dataset: Dataset) -> None:
        """Find the imaged space, and let the first ball stand on a floor that a reconstruction's points show.

        A floor often has no texture. Nothing then pulls a surface to it, and the background would explain it.
        """
        if self.hidden is not None and self.sphere is not None:
            least = max(self.config.rays_shared_by, 1)
            self.hidden.show(dataset.cameras, nearest_shown(dataset), least, self.sphere)
        distance = self.field.distance
        if self.sphere is None or dataset.points is None or not isinstance(distance, GridDistance):
            return
        sphere, up = self.sphere.to(dataset.points), dataset.points.new_tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        near = dataset.points[(dataset.points - sphere[:3]).norm(dim=-1) < sphere[3]]
        eyes = dataset.cameras.camera_to_worlds[:, :, 3]
        floor = find_floor(near, up, tolerance=FLOOR_TOLERANCE * float(sphere[3]), above=eyes)
        if floor is not None and floor.share >= LEAST_ON_FLOOR:
            distance.stand_on(floor.normal.to(sphere), floor.center.to(sphere))
            say(f"the first ball stands on a floor, where {floor.share:.0%} of {len(near):,} points lie")

    @torch.no_grad()
    def signed_distance(self, points: Points) -> tuple[Tensor, Tensor]:
        """Return the signed distance (N,) at `points`, scene units, negative inside, and its gradient (N, 3).

        The distance is NaN outside the sphere, where the background shows the scene.
        """
        shape = self.field.shape(points.positions)
        if self.sphere is None:
            return shape.distances, shape.gradients
        sphere = self.sphere.to(points.positions)
        outside = (points.positions - sphere[:3]).norm(dim=-1) > sphere[3]
        distances = torch.where(outside, torch.nan, shape.distances)
        return distances, shape.gradients

    @property
    def grid_density(self) -> DensityFunction:
        return self.field.density_around
