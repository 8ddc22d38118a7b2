"""K-Planes: products of feature planes in space and time, at several scales.

Fridovich-Keil et al., "K-Planes: Explicit Radiance Fields in Space, Time, and Appearance", CVPR 2023.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from nerfloom import Decision, LearnsMotion, Method, Points, RayModel, Scene
from nerfloom.base import device as devices
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.encodings.planes import FeaturePlanes, resolutions_of, scales_for
from nerfloom.fields.base import MLP
from nerfloom.fields.encoded import BoxField, EncodedField
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.grids.plane_bands import squared_steps
from nerfloom.kernels.grids.planes_layout import MAX_VERTICES
from nerfloom.kernels.math import truncated_exp
from nerfloom.losses.few_images import FewImagesConfig, decide_few_images
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.losses.terms import COLOR_ERROR, FEW_IMAGES, KNOWN_DISTANCES, SamplerLoss
from nerfloom.samplers.choice import SamplingConfig, batch_choice, contracted_box, make_sampler, sampler_choice
from nerfloom.samplers.motion import MotionConfig, slices_choice, vertices_in_time

MIN_SAMPLES, MAX_SAMPLES, MIN_SAMPLES_SECONDS = 2**14, 2**15, 75.0
"""Samples per training step of a static scene, for short and long times, and the seconds before they grow. On Lego
2^14 and 2^15 samples gave 28.58 and 27.84 dB after 45 s, 32.70 and 33.18 dB after 150 s."""
MOVING_SAMPLES, MOVING_SAMPLES_OF_A_GPU = 2**13, 2**16
"""Samples per training step of a moving scene, on a CPU and on a GPU, where more samples cost little."""
NUM_STEPS, MOVING_NUM_STEPS = 512, 224
"""Steps along the diagonal of the box, for static and for moving scenes."""
MAX_SCALES = 4
"""Maximum number of scales if the setting is open; the paper's number."""


@dataclass(frozen=True)
class KPlanesConfig(
    SamplingConfig,
    FewImagesConfig,
    MotionConfig,
    max_num_iterations=30_000,
    learning_rate=1e-2,
    lr_schedule="hold-exponential",
    num_steps=AUTO,
    eval_step_scale=AUTO,
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-12,
    thin_gradients=0.5,
):
    """Settings of kplanes."""

    RANGES: ClassVar[dict[str, Range]] = {
        "base_resolution": (2, MAX_VERTICES),
        "num_scales": (1, 16),
        "time_resolution": (3, MAX_VERTICES),
        "features_per_scale": (1, 2**14),
        "hidden_width": (1, 2**14),
        "space_tv": AT_LEAST_0,
        "time_smoothness": AT_LEAST_0,
        "time_sparsity": AT_LEAST_0,
    }
    decoder: Literal["hybrid", "explicit"] = "hybrid"
    """hybrid: two small networks. explicit: density linear in the features, and a learnt colour basis."""
    base_resolution: int = 64
    """Vertices per axis of space at the coarsest scale; each further scale has twice as many."""
    num_scales: Auto[int] = AUTO
    """Number of scales. auto: until the finest has a vertex per image pixel, but at most 4."""
    time_resolution: Auto[int] = AUTO
    """Vertices along the time axis at every scale, at least 3. auto: a sixth of the number of image times. The paper
    uses half of that number, with many times longer training."""
    grid_resolution: Auto[int] = AUTO
    """Cells along each axis of the occupancy grid (occupancy). auto: 128, or 64 with time slices."""
    features_per_scale: int = 32
    """Features per vertex of a plane."""
    hidden_width: int = 64
    """Features per hidden layer of the networks."""
    space_tv: float = 1e-4
    """Weight of the total variation of the planes in space."""
    time_smoothness: float = 0.1
    """Weight of the squared second differences of the planes along time."""
    time_sparsity: float = 1e-4
    """Weight of the mean distance of time planes from one, their value where nothing moves."""
    sparse_updates: bool = True
    """Whether Adam updates only the table entries that a step used."""


class ExplicitField(BoxField):
    """A field with density linear in the features, and colour linear in them with a learnt basis (section 3.4).

    The basis is a small network of the direction.

    Args:
        box: (2, 3) minimum and maximum corner of the encoded region, scene units.
        planes: encoding of positions, and of times if the scene moves.
        width: features per hidden layer of the basis network.
        unbounded: whether all of space is encoded, contracted around the box.
    """

    def __init__(self, box: Tensor, planes: FeaturePlanes, width: int, unbounded: bool = False) -> None:
        super().__init__(box, planes, unbounded)
        self.density_head = torch.nn.Linear(planes.num_features, 1, bias=False)
        self.basis = MLP(16, width, width, 3 * planes.num_features)

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        features = self.encode(points.positions, points.times)
        return truncated_exp(self.density_head(features)[:, 0]), features

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        basis = self.basis(spherical_harmonics(directions)).view(len(features), 3, features.shape[1])
        return torch.sigmoid((basis * features[:, None]).sum(-1).float())


class PlaneRegularity(LossTerm):
    """Total variation in space, roughness in time, and distance of time planes from one (equations 4 to 6).

    Each is a mean over planes, estimated without bias from a small part: a random band of rows of each space plane, and
    one whole time plane. On a GPU all time planes cost little more than one, and a step that always reads all of them
    can be captured.
    """

    def __call__(self, shown: RenderedBatch) -> dict[str, Tensor]:
        model, config, zero = shown.model, shown.model.config, shown.rendered.rgb.new_zeros(())
        assert isinstance(model.field, BoxField)
        turn = int(torch.randint(2**31, ())) if model.scene.moving and not devices.runs_ahead(zero.device) else None
        variation, roughness, activity = self.of(model.field, zero, turn)
        terms = {"space_tv": config.space_tv * variation}
        if model.scene.moving:
            terms["time_smoothness"] = config.time_smoothness * roughness
            terms["time_sparsity"] = config.time_sparsity * activity
        return terms

    def of(self, field: BoxField, zero: Tensor, turn: int | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return total variation, roughness and distance from one.

        Args:
            field: the field of planes.
            zero: () result if there are no time planes.
            turn: index, modulo their number, of the time plane; None for all.
        """
        planes = field.encoding
        assert isinstance(planes, FeaturePlanes)
        factors = planes.all_factors
        in_time = [(scale, index) for scale, index in factors if 3 in planes.layout.axes[scale][index]]
        in_space = [factor for factor in factors if factor not in in_time]
        variation = planes.variation(in_space).sum() / (2 * len(factors))
        if not in_time:
            return variation, zero, zero
        chosen = planes.bands(in_time if turn is None else [in_time[turn % len(in_time)]], whole={3})
        share = len(in_time) / len(factors) / len(chosen)
        variation = variation + share * torch.stack([squared_steps(plane, 1) for plane in chosen]).sum()
        roughness = torch.stack([plane.diff(n=2, dim=0).square().mean() for plane in chosen]).mean()
        return variation, roughness, torch.stack([(1 - plane).abs().mean() for plane in chosen]).mean()


class KPlanes(RayModel[KPlanesConfig], LearnsMotion, plain=True):
    """A model of feature planes in space and, if the scene moves, in time, with the paper's regularisers."""

    losses = (COLOR_ERROR, SamplerLoss(), *KNOWN_DISTANCES, PlaneRegularity("planes"), *FEW_IMAGES)
    steps_repeat = True


def decide(config: KPlanesConfig, scene: Scene) -> tuple[KPlanesConfig, list[Decision]]:
    """Fill in the settings that depend on the scene."""
    scales = scales_for(scene.image_size, config.base_resolution, MAX_SCALES)
    config, made = fill(
        config,
        sampler_choice(config, scene.unbounded),
        Choice("num_scales", scales, f"the images have {scene.image_size} pixels", "scales"),
    )
    config, few = decide_few_images(config, scene)
    samples = batch_choice(config, MIN_SAMPLES, MAX_SAMPLES, MIN_SAMPLES_SECONDS)
    if scene.moving:
        count = MOVING_SAMPLES if devices.device_kind(config.machine) == "cpu" else MOVING_SAMPLES_OF_A_GPU
        samples = Choice("samples_per_batch", count, "the scene moves", "samples a step")
    steps = Choice("num_steps", MOVING_NUM_STEPS if scene.moving else NUM_STEPS, "the scene moves")
    shorter = Choice(
        "eval_step_scale", 0.5 if scene.moving else 1.0, "edges are sharper", "length of a step in rendering"
    )
    config, batch = fill(config, samples)
    config, paces = fill(config, steps, shorter)
    config, slices = fill(config, slices_choice(scene, config.sampler))
    sliced = config.time_slices > 1
    config, coarser = fill(config, Choice("grid_resolution", 64 if sliced else 128, "each slice has cells of its own"))
    times = f"the images have {scene.num_times} times"
    config, along = fill(config, Choice("time_resolution", vertices_in_time(scene), times, "vertices along time"))
    made += few + batch + coarser * sliced + (paces + slices * sliced + along) * scene.moving
    if not scene.moving:
        made.append(Decision("planes of time", "left out", "the images have no times"))
    return config, made


def make_field(config: KPlanesConfig, scene: Scene) -> BoxField:
    """Return a field on feature planes, with the configured decoder."""
    time = (config.time_resolution,) if scene.moving else ()
    resolutions = resolutions_of(scene.box, config.base_resolution, config.num_scales, time)
    sparse, opening = config.sparse_updates, config.open_levels_until
    planes = FeaturePlanes(resolutions, config.features_per_scale, sparse=sparse, opening=opening)
    kind = EncodedField if config.decoder == "hybrid" else ExplicitField
    return kind(scene.box, planes, config.hidden_width, unbounded=contracted_box(config, scene) is not None)


METHOD = Method(
    KPlanesConfig(), paper="arXiv:2301.10241", field=make_field, sampler=make_sampler, model=KPlanes, decide=decide
)
