"""NeRF in the Wild: photographs that differ in light and show people and things that appear in one of them only.

Martin-Brualla et al., "NeRF in the Wild: Neural Radiance Fields for Unconstrained Photo Collections", CVPR 2021. Each
training image has an appearance vector, an input of the static colours, and a transient vector. A second head turns the
transient vector into density, colour and uncertainty that exist in that image alone. Where an image disagrees with the
others, this costs less than changing the scene. Other views show the static part alone.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, cast

from torch import Tensor

from nerfloom import Decision, Method, Picture, PixelBatch, RayModel, Rays, Rendered, Sampler, Scene, View
from nerfloom.base.config import AT_LEAST_0, Range, VectorConfig
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.optimised import Optimised
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.planes import FeaturePlanes, resolutions_of, scales_for
from nerfloom.fields.appearance import make_vectors
from nerfloom.fields.encoded import NUM_FEATURES, EncodedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.fields.transient import TransientHead
from nerfloom.geometry.bounds import half_edge
from nerfloom.losses.functions import doubted_error
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.losses.terms import KNOWN_DISTANCES, Distortion, SamplerLoss
from nerfloom.methods._captures import CaptureConfig, RefinedModel, decide_capture
from nerfloom.rendering.transient import STATIC, UNCERTAINTY, TransientRenderer
from nerfloom.rendering.volume import scaled_up_to
from nerfloom.samplers.choice import decide_samples, make_sampler

PAPER_WIDTH, GRID_WIDTH = 256, 64
"""Features per hidden layer: the paper's networks, with half as many in their heads, and networks on a hash grid."""
PLANES, PLANE_FEATURES, MAX_SCALES = 64, 32, 4
"""Vertices along an axis at the coarsest scale of planes, features of a vertex, and the maximum number of scales: those
of K-Planes (Fridovich-Keil et al. 2023) for Photo Tourism."""
PLANE_VARIATION = 1e-4
"""Weight of the total variation of planes, as in kplanes."""
PAPER_RATE = 0.05
"""Learning rate of the paper's networks, relative to a hash grid's: 5e-4 by default."""
START = 0.05
"""Transient density before training, per half edge of the box."""
SAMPLES = 2**15
"""Samples per training step with an occupancy grid over a box."""


@dataclass(frozen=True)
class NerfWConfig(CaptureConfig, VectorConfig, max_num_iterations=30_000, appearance_embedding_dim=48, robust="off"):
    """Settings of nerf-w; open ones depend on the scene."""

    RANGES: ClassVar[dict[str, Range]] = {
        "transient_embedding_dim": (1, 2**10),
        "least_uncertainty": (1e-4, 1e4),
        "transient_density_mult": AT_LEAST_0,
    }
    encoding: Literal["hash-grid", "planes", "frequency"] = "hash-grid"
    """hash-grid: small networks on a hash grid. planes: the same on the feature planes of K-Planes. frequency: the
    paper's networks, of 8 layers of 256 features."""
    transient_embedding_dim: int = 16
    """Length of an image's transient vector."""
    least_uncertainty: float = 0.1
    """Standard deviation of colours where nothing is transient; 0.03 in the paper."""
    transient_density_mult: float = 0.01
    """Weight of the mean transient density, per half edge of the box."""


class DoubtedError(LossTerm):
    """Error of colours in units of their uncertainty."""

    def __call__(self, shown: RenderedBatch) -> Tensor:
        pixels, batch = shown.pixels, shown.batch
        least = shown.model.config.least_uncertainty
        return doubted_error(pixels.rgb, batch.rgb, pixels.extras[UNCERTAINTY.name], least, shown.batch.weights)


class TransientDensity(LossTerm):
    """Mean transient density, per half edge of the box: NeRF-W, equation 13, in the unit of `doubted_error`."""

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        density = shown.rendered.extras.get("transient_density")  # None for the views of a teacher
        unit = 2 * shown.model.config.least_uncertainty**2 * half_edge(shown.model.scene.box)
        return None if density is None or not len(density) else unit * density.mean()


class PlaneVariation(LossTerm):
    """Total variation of feature planes: K-Planes, equation 4; from a random band of rows of each, without bias."""

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        return bool(model.config.encoding == "planes")

    def __call__(self, shown: RenderedBatch) -> Tensor:
        planes = cast("FeaturePlanes", cast("EncodedField", shown.model.field).encoding)
        return planes.variation(planes.all_factors).sum() / (2 * len(planes.all_factors))


class NerfW(RefinedModel[NerfWConfig], plain=True):
    """A model that gives less weight to an image where the others disagree with it."""

    losses = (
        DoubtedError("rgb"),
        TransientDensity("transient", "transient_density_mult"),
        SamplerLoss(),
        *KNOWN_DISTANCES,
        Distortion(),
        PlaneVariation("planes", PLANE_VARIATION),
    )
    renderer: TransientRenderer

    def lit(self, rendered: Rendered, rays: Rays, background: Tensor) -> Rendered:
        if self.light is None:
            return rendered
        static = super().lit(replace(rendered, rgb=rendered.extras[STATIC.name]), rays, background)
        both = super().lit(replace(rendered, accumulation=rendered.extras["opacity"]), rays, background)
        extras = {**both.extras, STATIC.name: static.rgb}
        return replace(both, accumulation=rendered.accumulation, extras=extras)

    def render_view(self, view: View, background: Tensor) -> Picture:
        if view.image is None:
            return super().render_view(view, background)
        appearance = self.appearance
        lit = nullcontext() if appearance is None else appearance.shown(appearance.of_images()[view.image].detach())
        with lit, self.renderer.head.shown(view.image):
            return super().render_view(view, background)


def decide(config: NerfWConfig, scene: Scene) -> tuple[NerfWConfig, list[Decision]]:
    """Fill in the settings that depend on the scene."""
    config, scaled = fill(config, Choice("gradient_scaling", True, "things near one camera may be in its image alone"))
    config, made = decide_capture(config, scene)
    config, samples = decide_samples(config, SAMPLES)
    return config, scaled + made + samples


def make_field(config: NerfWConfig, scene: Scene) -> EncodedField | NeRFField:
    """Return the static field, with appearance vectors if the settings have them."""
    appearance = make_vectors(config, scene)
    if config.encoding == "frequency":
        field = NeRFField(PAPER_WIDTH, contracted=scene.box if config.contraction else None, appearance=appearance)
        field.optimised = _optimised(config)
        return field
    encoding = _planes(scene) if config.encoding == "planes" else HashGrid.of(config, 0.0)
    return EncodedField(scene.box, encoding, GRID_WIDTH, unbounded=config.contraction, appearance=appearance)


def _planes(scene: Scene) -> FeaturePlanes:
    """Return feature planes that suit a scene."""
    resolutions = resolutions_of(scene.box, PLANES, scales_for(scene.image_size, PLANES, MAX_SCALES))
    return FeaturePlanes(resolutions, PLANE_FEATURES, sparse=True)


def sampler(config: NerfWConfig, scene: Scene) -> Sampler:
    """Return the configured sampler; it uses the static density alone."""
    return make_sampler(config, replace(scene, unbounded=config.contraction))


def renderer(config: NerfWConfig, scene: Scene) -> TransientRenderer:
    """Return the renderer, with the transient head."""
    features, width = (PAPER_WIDTH, PAPER_WIDTH // 2) if config.encoding == "frequency" else (NUM_FEATURES, GRID_WIDTH)
    sizes = features, scene.num_cameras, config.transient_embedding_dim, width
    head = TransientHead(*sizes, scene.box, START / half_edge(scene.box))
    made = TransientRenderer(head, config.least_uncertainty, scaled_up_to(config, scene), config.thin_gradients)
    made.optimised = _optimised(config)
    return made


def _optimised(config: NerfWConfig) -> Optimised | None:
    """Return the optimiser settings of the paper's networks; None on a hash grid."""
    return Optimised(learning_rate=PAPER_RATE * config.learning_rate) if config.encoding == "frequency" else None


METHOD = Method(
    NerfWConfig(),
    paper="arXiv:2008.02268",
    field=make_field,
    sampler=sampler,
    renderer=renderer,
    model=NerfW,
    decide=decide,
)
