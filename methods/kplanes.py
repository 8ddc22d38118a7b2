"""K-Planes: products of feature planes in space and time, at several scales.

Fridovich-Keil et al., "K-Planes: Explicit Radiance Fields in Space, Time, and Appearance", CVPR 2023.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from framework import Decision, LearnsMotion, Method, PixelBatch, Points, RayModel, Rendered, Scene
from framework.base.config import AT_LEAST_0, AUTO, Auto, Range
from framework.base.decisions import Choice, fill
from framework.encodings.planes import FeaturePlanes
from framework.fields.base import MLP
from framework.fields.encoded import BoxField, EncodedField
from framework.kernels.math import truncated_exp
from framework.kernels.planes import MAX_VERTICES, plane_band
from framework.kernels.spherical_harmonics import spherical_harmonics
from framework.samplers.choice import SamplingConfig, contracted_box, make_sampler, sampler_choice

MAX_SCALES = 4


@dataclass(frozen=True)
class KPlanesConfig(
    SamplingConfig,
    max_num_iterations=30_000,
    samples_per_batch=2**15,
    learning_rate=1e-2,
    lr_schedule="hold-exponential",
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-12,
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
    """What these numbers may be."""
    decoder: Literal["hybrid", "explicit"] = "hybrid"
    """hybrid: two small networks. explicit: linear density, and a learned basis of colours."""
    base_resolution: int = 64
    """Vertices along an axis of space at the coarsest scale; each scale doubles it."""
    num_scales: Auto[int] = AUTO
    """Scales. If not given: as many as the images' pixels can show, 4 at most."""
    time_resolution: int = 25
    """Vertices along time, at every scale; a second difference needs 3."""
    features_per_scale: int = 32
    """Features of a plane's vertex."""
    hidden_width: int = 64
    """Features of a layer of the networks."""
    space_tv: float = 1e-4
    """Weight of the planes' total variation in space."""
    time_smoothness: float = 0.1
    """Weight of the planes' second difference in time."""
    time_sparsity: float = 1e-4
    """Weight of what keeps the planes of time at one, where nothing moves."""
    sparse_updates: bool = True
    """Adam updates only the entries that a step used."""


class ExplicitField(BoxField):
    """Linear density, and colour as features times a basis that a small network of the direction learns (section 3.4).

    Args:
        box: (2, 3) the part of space that is encoded.
        planes: the encoding.
        width: features of the basis network's hidden layers.
        unbounded: encode all of space, contracted.
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


class KPlanes(RayModel[KPlanesConfig], LearnsMotion):
    """Planes of features in space and, for a scene that moves, in time, with the paper's regularisers."""

    def regularizers(self, rendered: Rendered, batch: PixelBatch, step: int) -> dict[str, Tensor]:
        variation, roughness, activity = self._regularisers(rendered.rgb.new_zeros(()))
        losses = {"space_tv": self.config.space_tv * variation}
        if self.scene.moving:
            losses["time_smoothness"] = self.config.time_smoothness * roughness
            losses["time_sparsity"] = self.config.time_sparsity * activity
        return losses

    def _regularisers(self, zero: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Total variation in space, roughness in time, distance of time's planes from one: means over planes.

        Equations 4 to 6, on a random band of rows of each plane of space, and on time's small planes whole.
        """
        assert isinstance(self.field, BoxField)
        planes = self.field.encoding
        assert isinstance(planes, FeaturePlanes)
        variations, roughness, activity = [], [zero], [zero]
        for scale in range(planes.layout.num_groups):
            for index, axes in enumerate(planes.layout.axes[scale]):
                if 3 not in axes:
                    band = planes.random_band(scale, index)
                    variations.append((_squared_steps(band, 0) + _squared_steps(band, 1)) / 2)
                    continue
                height, _ = planes.layout.shape(scale, index)
                plane = plane_band(planes.table, planes.layout, scale, index, 0, height, planes.deferred)
                variations.append(_squared_steps(plane, 1))
                roughness.append(plane.diff(n=2, dim=0).square().mean())
                activity.append((1 - plane).abs().mean())
        count = max(len(roughness) - 1, 1)
        return torch.stack(variations).mean(), torch.stack(roughness).sum() / count, torch.stack(activity).sum() / count


def _squared_steps(plane: Tensor, dim: int) -> Tensor:
    """Mean squared difference of neighbours; 0 where there are none."""
    return plane.diff(dim=dim).square().mean() if plane.shape[dim] > 1 else plane.new_zeros(())


def decide(config: KPlanesConfig, scene: Scene) -> tuple[KPlanesConfig, list[Decision]]:
    """Return the settings with what the scene decides, and why.

    Args:
        config: settings, some of which may be open.
        scene: facts about the data.
    """
    scales = 1  # until a plane has a vertex a pixel or more, but no more than the paper's 4
    while scales < MAX_SCALES and config.base_resolution << (scales - 1) < scene.image_size:
        scales += 1
    config, made = fill(
        config,
        sampler_choice(config, scene.unbounded),
        Choice("num_scales", scales, f"the images have {scene.image_size} pixels", "scales"),
    )
    if not scene.moving:
        made.append(Decision("planes of time", "left out", "the images have no times"))
    return config, made


def make_field(config: KPlanesConfig, scene: Scene) -> BoxField:
    """Return a field that reads feature planes.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    """
    time = (config.time_resolution,) if scene.moving else ()
    resolutions = tuple((config.base_resolution << scale,) * 3 + time for scale in range(config.num_scales))
    planes = FeaturePlanes(resolutions, config.features_per_scale, sparse=config.sparse_updates)
    kind = EncodedField if config.decoder == "hybrid" else ExplicitField
    return kind(scene.box, planes, config.hidden_width, unbounded=contracted_box(config, scene) is not None)


METHOD = Method(
    KPlanesConfig(), paper="arXiv:2301.10241", field=make_field, sampler=make_sampler, model=KPlanes, decide=decide
)
