"""Terms of methods that predict normals: Ref-NeRF (Verbin et al. 2022), equations 10 and 11."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.fields.base import Field
from nerfloom.fields.directional import HasDensityNormals, predicted_normals
from nerfloom.fields.normals import facing_away, normal_difference
from nerfloom.geometry.points import interval_points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.march.waves import Wave
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.rendering.rendered import Rendered

if TYPE_CHECKING:
    from nerfloom.ray_model import RayModel

COARSE_SHARE = 0.1
"""Weight of a coarse level's penalty, relative to the fine one's."""
SHARE = 1 / 16
"""`PredictedNormals` uses at most this fraction of the samples, on average."""


class NormalPenalty(LossTerm):
    """Mean over rays of a penalty of `normal_penalties`, "normals" or "orientation", from the renderer's extras."""

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        penalty: Tensor = shown.rendered.extras[f"{self.name}_penalty"]
        return penalty.mean() if len(penalty) else None


class PredictedNormals(LossTerm):
    """Penalties on the predicted normals of reflected directions, in methods with `PredictedNormalsConfig`.

    They are "normals", the difference from the density's normals, which trains the density too, and "orientation", on
    visible normals that face away from the camera. Each is a mean over rays of sums over samples. The sums are
    estimated without bias from samples that are drawn at random by their weights.
    """

    def __init__(self) -> None:
        super().__init__("normals")

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        config = model.config
        return config.directional == "reflected" and (config.normal_loss_mult > 0 or config.orientation_loss_mult > 0)

    def __call__(self, shown: RenderedBatch) -> dict[str, Tensor]:
        rendered, field, config = shown.rendered, shown.model.field, shown.model.config
        found = penalties(rendered, shown.batch.rays, field)
        if rendered.coarse is not None:
            coarse = penalties(rendered.coarse, shown.batch.rays, field)
            found = {name: value + COARSE_SHARE * coarse[name] for name, value in found.items()}
        factors = {"normals": config.normal_loss_mult, "orientation": config.orientation_loss_mult}
        return {name: factors[name] * value for name, value in found.items()}

    def varies(self, config: Any) -> str | None:
        return "normals are compared at random samples" if config.directional == "reflected" else None


PREDICTED_NORMALS = PredictedNormals()


def penalties(rendered: Rendered, rays: Rays, field: Field) -> dict[str, Tensor]:
    """Return the mean penalties () of rays by name, "normals" and "orientation".

    Args:
        rendered: R rendered rays with their samples and weights.
        field: the field that was sampled.
    """
    samples, weights = rendered.samples, rendered.weights
    assert isinstance(field, HasDensityNormals)
    assert samples is not None
    assert samples.features is not None
    assert weights is not None
    weights = weights.detach()  # the penalties change normals only; in the authors' code, samples also lose weight
    places, factors = drawn(weights, SHARE)
    columns = samples.ray_indices, samples.t_starts, samples.t_ends, samples.t
    owners, starts, ends, t = (each.detach().index_select(0, places) for each in columns)
    positions = rays.points(owners, t).detach()
    points = interval_points(rays, owners, Wave(starts, ends, owners, positions), positions, field.footprint)
    shares = weights.index_select(0, places) * factors / max(samples.num_rays, 1)
    predicted = predicted_normals(samples.features.index_select(0, places))
    apart = normal_difference(predicted, field.density_normals(points))
    away = facing_away(predicted, rays.directions.detach().index_select(0, owners))
    return {"normals": (shares * apart).sum(), "orientation": (shares * away).sum()}


def drawn(weights: Tensor, share: float) -> tuple[Tensor, Tensor]:
    """Return samples that are drawn at random by their weights, and factors that keep the expectation of sums.

    A sample is drawn with a probability proportional to its weight, at most 1.

    Args:
        weights: (N,) weights of samples, at least 0.
        share: fraction of the samples that is drawn on average, if no probability reaches 1.

    Returns:
        indices (K,) of the drawn samples, and one over their probabilities (K,).
    """
    # If all weights are 0, the probabilities are NaN, and no sample is drawn.
    chances = (weights * (share * len(weights) / weights.sum())).clamp(max=1)
    places = (torch.rand_like(chances) < chances).nonzero()[:, 0]
    return places, 1 / chances.index_select(0, places)
