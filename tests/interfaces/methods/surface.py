"""Surface: a signed distance with a gradient of length 1, opaque as in NeuS (Wang et al. 2021, equation 13)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nerfloom import Field, Method, Points, RayModel, Scene
from nerfloom.fields.base import MLP
from nerfloom.kernels import dispatch
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.samplers.choice import SamplingConfig, decide_sampler, make_sampler


@dataclass(frozen=True)
class SurfaceConfig(SamplingConfig, max_num_iterations=2_000, samples_per_batch=2**13, learning_rate=5e-3):
    """Settings of surface."""

    sharpness: float = 20.0
    """First inverse width of the transition to opaque at a surface, 1/length."""


class SurfaceField(Field):
    """A signed distance, at first of a ball of a `radius`, and colour; `sharpness` is as in the settings."""

    def __init__(self, radius: float, sharpness: float) -> None:
        super().__init__()
        self.radius = radius
        self.trunk = MLP(3 + 6 * 4, 64, 64, 17)
        self.head = MLP(16 + 16, 64, 3, activation="sigmoid")
        self.log_sharpness = nn.Parameter(torch.tensor(sharpness).log())

    def shape(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Return signed distances (N,) and features (N, 16) at positions (N, 3)."""
        values = self.trunk(frequency_encoding(positions, 4)).float()
        return positions.norm(dim=-1) - self.radius + 0.1 * values[:, 0], values[:, 1:]

    def signed_distance(self, points: Points) -> Tensor:
        return self.shape(points.positions)[0]

    def alpha(self, points: Points, directions: Tensor, deltas: Tensor) -> tuple[Tensor, Tensor]:
        reach = directions * (deltas / 2)[:, None]
        inverse_width = self.log_sharpness.exp()
        ends = [self.shape(points.positions + side * reach)[0] * inverse_width for side in (-1, 1)]
        # 1 - sigmoid(b) / sigmoid(a) in logarithms, so that neither underflows.
        closed = -torch.expm1((nn.functional.logsigmoid(ends[1]) - nn.functional.logsigmoid(ends[0])).clamp(max=0))
        return closed, self.shape(points.positions)[1]

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        distances, features = self.shape(points.positions)
        inverse_width = self.log_sharpness.exp()
        return inverse_width * torch.sigmoid(-inverse_width * distances), features  # as opaque as it can get

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return self.head(features, spherical_harmonics(directions)).float()


class Eikonal(LossTerm):
    """Mean squared difference of the length of the distance's gradient from 1 (Gropp et al. 2020), at some samples."""

    def __call__(self, shown: RenderedBatch) -> Tensor:
        positions = shown.rendered.samples.positions(shown.batch.rays)[::8].detach().requires_grad_()
        with dispatch.derivatives(2):
            distances, _ = shown.model.field.shape(positions)
            (gradient,) = torch.autograd.grad(distances.sum(), positions, create_graph=True)
            return (gradient.norm(dim=-1) - 1).square().sum() / max(len(positions), 1)


class Surface(RayModel[SurfaceConfig]):
    losses = (*RayModel.losses, Eikonal("eikonal", 0.01))


def make_field(config: SurfaceConfig, scene: Scene) -> SurfaceField:
    """Return a ball of a quarter of the box's width."""
    return SurfaceField(float((scene.box[1] - scene.box[0]).min()) / 4, config.sharpness)


METHOD = Method(SurfaceConfig(), "none", make_field, make_sampler, model=Surface, decide=decide_sampler)
