"""TensoRF: density and appearance as sums of products of planes and lines (VM), or of lines alone (CP).

Chen et al., "TensoRF: Tensorial Radiance Fields", ECCV 2022.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor
from torch.nn.functional import softplus

from framework import (
    Decision,
    Field,
    Method,
    PixelBatch,
    Points,
    RayModel,
    Rendered,
    Renderer,
    Sampler,
    Scene,
)
from framework.base.config import AT_LEAST_0, AUTO, Auto, Range
from framework.base.decisions import Choice, fill
from framework.base.optimised import Optimised
from framework.encodings.planes import FeaturePlanes
from framework.fields.base import MLP
from framework.geometry.bounds import to_unit_box
from framework.kernels.contraction import contract_to_unit
from framework.kernels.memory import require
from framework.kernels.planes import PlanesLayout
from framework.kernels.spherical_harmonics import spherical_harmonics
from framework.samplers.base import SkipsCells
from framework.samplers.choice import SamplingConfig, contracted_box, make_sampler, sampler_choice

VM = (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,)))
"""Three groups: a plane, and the line across it (equation 4)."""
CP = (((0,), (1,), (2,)),)
"""One group: a line along each axis (equation 3)."""
DENSITY_SHIFT, DENSITY_SCALE = -10.0, 25.0
"""Density is DENSITY_SCALE * softplus(sum of components + DENSITY_SHIFT): empty at first (section 4.4 and its code)."""
BLIND_STEPS = 128
"""The field is empty at first: until it has learnt something, it does not say what cells to skip."""
FIRST_SIDE, LAST_SIDE = 128, {"vm": 300, "cp": 500}
"""Of the first grid and the last one, as cubes (section 5)."""
VERTICES_PER_PIXEL = 2
"""Along an axis, of the photographs' longer side: more tell nothing apart, and each of them has to be learnt."""
MARGIN = 1
"""Cells of the occupancy grid kept around what is occupied when the box shrinks."""


@dataclass(frozen=True)
class TensoRFConfig(
    SamplingConfig,
    max_num_iterations=30_000,
    samples_per_batch=2**15,
    learning_rate=2e-2,
    lr_schedule="exponential",
    lr_final=0.1,
    adam_beta2=0.99,
):
    """Settings of tensorf."""

    RANGES: ClassVar[dict[str, Range]] = {
        "network_learning_rate": AT_LEAST_0,
        "density_components": (1, 2**14),
        "appearance_components": (1, 2**14),
        "first_voxels": (8, 2**30),
        "last_voxels": (8, 2**30),
        "upsample_at": AT_LEAST_0,
        "sparsity": AT_LEAST_0,
        "total_variation": AT_LEAST_0,
        "hidden_width": (1, 2**14),
    }
    """What these numbers may be."""
    network_learning_rate: float = 1e-3
    """Of the basis and the colour network."""
    decomposition: Literal["vm", "cp"] = "vm"
    """vm: planes and lines. cp: lines alone, which is slower to learn and under 4 MB."""
    density_components: Auto[int] = AUTO
    """Of each group. If not given: 16 (vm) or 96 (cp)."""
    appearance_components: Auto[int] = AUTO
    """Of each group. If not given: 48 (vm) or 288 (cp)."""
    first_voxels: Auto[int] = AUTO
    """Voxels that the vertices of the first grid make. If not given: 128^3, or what the photographs tell apart."""
    last_voxels: Auto[int] = AUTO
    """The same for the last grid. If not given: 300^3 (vm) or 500^3 (cp), or what the photographs tell apart."""
    upsample_at: tuple[float, ...] = (0.07, 0.1, 0.13, 0.18, 0.23)
    """Shares of the budget after which the grid grows, in equal ratios; the box shrinks to what is occupied before."""
    sparsity: float = 8e-5
    """Weight of the mean absolute values of density's factors; half of it once the grid has grown."""
    total_variation: float = 0.0
    """Weight of the factors' total variation, of appearance a tenth; for photographs of real scenes, 0.01 and more."""
    hidden_width: int = 128
    """Features of a layer of the colour network."""
    sparse_updates: bool = True
    """Adam updates only the entries that a step used."""


class TensorField(Field):
    """Density as a sum of components; colour from components of its own by a basis and a small network (section 4.3).

    Args:
        box: (2, 3) the part of space that is encoded.
        density, appearance: the factors.
        width: features of the colour network's hidden layers.
        num_features: of which the basis makes the appearance (27 in the paper).
        unbounded: the factors stand in all of space, contracted.
    """

    box: Tensor
    runs_on_kernels = True

    def __init__(
        self,
        box: Tensor,
        density: FeaturePlanes,
        appearance: FeaturePlanes,
        width: int,
        num_features: int = 27,
        unbounded: bool = False,
    ) -> None:
        super().__init__()
        self.unbounded = unbounded
        self.register_buffer("box", box.clone())
        self.density_factors, self.appearance_factors = density, appearance
        self.basis = torch.nn.Linear(appearance.num_features, num_features, bias=False)
        self.color_head = MLP(num_features + 16, width, width, 3, activation="sigmoid")

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        unit = self._unit(points.positions)
        return self._sigma(self.density_factors(unit), unit), unit

    @staticmethod
    def _sigma(components: Tensor, unit: Tensor) -> Tensor:
        """Density of summed components, and none outside the box, which may have shrunk."""
        inside = ((unit >= 0) & (unit <= 1)).all(-1)
        return softplus(components.float().sum(-1) + DENSITY_SHIFT) * DENSITY_SCALE * inside

    def _unit(self, positions: Tensor) -> Tensor:
        return contract_to_unit(positions, self.box) if self.unbounded else to_unit_box(positions, self.box)

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        appearance = self.basis(self.appearance_factors(features))
        return self.color_head(appearance.float(), spherical_harmonics(directions)).float()


class TensoRF(RayModel[TensoRFConfig]):
    """Factors that grow from coarse to fine, while their box shrinks to what an occupancy grid, if used, has found."""

    growths: Tensor
    """Times the grid has grown."""

    def __init__(self, config: TensoRFConfig, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        self.register_buffer("growths", torch.zeros((), dtype=torch.int64))

    @property
    def factors(self) -> TensorField:
        """The field, whose factors grow."""
        assert isinstance(self.field, TensorField)
        return self.field

    def before_step(self, step: int, progress: float) -> None:
        if step >= BLIND_STEPS or not isinstance(self.sampler, SkipsCells):
            super().before_step(step, progress)
        due = sum(progress >= share for share in self.config.upsample_at)
        if due > int(self.growths):
            self.growths.fill_(due)
            self._grow(due / len(self.config.upsample_at))

    @torch.no_grad()
    def _grow(self, share: float) -> None:
        """More voxels, over what of the box is occupied. Their number grows evenly in its logarithm."""
        voxels = self.config.first_voxels ** (1 - share) * self.config.last_voxels**share
        box, field = self._occupied_box(), self.factors
        vertices = vertices_of(voxels, box)
        if torch.equal(box, field.box) and vertices == field.density_factors.layout.resolutions[0]:
            return
        size = field.box[1] - field.box[0]
        lower, upper = (box[0] - field.box[0]) / size, (box[1] - field.box[0]) / size
        for factors in (field.density_factors, field.appearance_factors):
            factors.resample((vertices,) * factors.layout.num_groups, lower, upper)
        field.box.copy_(box)

    def _occupied_box(self) -> Tensor:
        """(2, 3) corners of what holds all occupied cells and a margin; the field's box where none is."""
        sampler, box = self.sampler, self.factors.box
        if not isinstance(sampler, SkipsCells):
            return box.clone()
        n = sampler.resolution
        cells = sampler.occupied.nonzero().squeeze(-1)
        if len(cells) == 0:
            return box.clone()
        corners = torch.stack([cells // n**2, cells // n % n, cells % n], dim=-1)
        ends = torch.stack([corners.min(0).values - MARGIN, corners.max(0).values + 1 + MARGIN]) / n
        found = torch.lerp(sampler.box[0], sampler.box[1], ends)
        return torch.stack([found[0].maximum(box[0]), found[1].minimum(box[1])])

    def regularizers(self, rendered: Rendered, batch: PixelBatch, step: int) -> dict[str, Tensor]:
        losses, field = dict[str, Tensor](), self.factors
        if self.config.sparsity:
            weight = self.config.sparsity * (0.5 if int(self.growths) else 1.0)
            losses["sparsity"] = weight * _sum_over_bands(field.density_factors, lambda band: band.abs().mean())
        if self.config.total_variation:
            variation = _sum_over_bands(field.density_factors, _variation)
            variation = variation + 0.1 * _sum_over_bands(field.appearance_factors, _variation)
            losses["total_variation"] = self.config.total_variation * variation
        return losses


def _sum_over_bands(factors: FeaturePlanes, measure: Callable[[Tensor], Tensor]) -> Tensor:
    """What is measured on a random band of rows of each factor."""
    axes = factors.layout.axes
    bands = (factors.random_band(group, index) for group in range(len(axes)) for index in range(len(axes[group])))
    return torch.stack([measure(band) for band in bands]).sum()


def _variation(band: Tensor) -> Tensor:
    """Sum over both axes of the mean squared difference of neighbours, where there are any."""
    found = band.new_zeros(())
    for dim in (0, 1):
        if band.shape[dim] > 1:
            found = found + band.diff(dim=dim).square().mean()
    return found


def decide(config: TensoRFConfig, scene: Scene) -> tuple[TensoRFConfig, list[Decision]]:
    """Return the settings with what the images tell apart, and why.

    Args:
        config: settings, some of which may be open.
        scene: facts about the data.
    """
    density, appearance = (16, 48) if config.decomposition == "vm" else (96, 288)
    told_apart = VERTICES_PER_PIXEL * scene.image_size
    first, last = (min(side, told_apart) for side in (FIRST_SIDE, LAST_SIDE[config.decomposition]))
    decomposed = f"the decomposition is {config.decomposition}"
    pixels = f"the images have {scene.image_size} pixels along a side"
    return fill(
        config,
        sampler_choice(config, scene.unbounded),
        Choice("density_components", density, decomposed),
        Choice("appearance_components", appearance, decomposed),
        Choice("first_voxels", first**3, pixels, shown=f"{first}^3"),
        Choice("last_voxels", last**3, pixels, shown=f"{last}^3"),
    )


def vertices_of(voxels: float, box: Tensor) -> tuple[int, ...]:
    """Return the vertices along each axis of a grid of about so many cubes over a box.

    Args:
        voxels: how many cubes.
        box: (2, 3) corners.
    """
    size = (box[1] - box[0]).tolist()
    edge = (math.prod(size) / voxels) ** (1 / 3)
    return tuple(max(round(length / edge), 2) for length in size)


def make_field(config: TensoRFConfig, scene: Scene) -> TensorField:
    """Return the factors and the network that reads them.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    Raises: ConfigError where the machine has less memory than the last grid takes.
    """
    axes = VM if config.decomposition == "vm" else CP
    counts = config.density_components, config.appearance_components
    for voxels in (config.first_voxels, config.last_voxels):  # before the training that the last would end
        layout = PlanesLayout.build((vertices_of(voxels, scene.box),) * len(axes), axes)
        require(4.0 * layout.num_entries * sum(counts), "a grid")
    vertices = (vertices_of(config.first_voxels, scene.box),) * len(axes)
    density, appearance = (
        FeaturePlanes(vertices, count, axes, config.sparse_updates, resizable=True) for count in counts
    )
    unbounded = contracted_box(config, scene) is not None
    field = TensorField(scene.box, density, appearance, config.hidden_width, unbounded=unbounded)
    field.optimised = Optimised("networks", learning_rate=config.network_learning_rate)
    for factors in (density, appearance):
        factors.optimised = Optimised("tables", config.learning_rate, sparse=config.sparse_updates)
        with torch.no_grad():  # of CP's triple products the factors are larger, as in the authors' code
            factors.table.normal_(0, 0.1 if config.decomposition == "vm" else 0.2)
    return field


METHOD = Method(
    TensoRFConfig(), paper="arXiv:2203.09517", field=make_field, sampler=make_sampler, model=TensoRF, decide=decide
)
