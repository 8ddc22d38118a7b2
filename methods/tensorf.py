"""TensoRF: density and appearance as sums of products of planes and lines (VM), or of lines alone (CP).

Chen et al., "TensoRF: Tensorial Radiance Fields", ECCV 2022.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from nerfloom import Decision, Field, Method, RayModel, Renderer, Sampler, Scene
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.device import HostValue
from nerfloom.base.optimised import Optimised
from nerfloom.base.step_kind import StepKind
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.tensor import CP, VM, TensorField
from nerfloom.geometry.bounds import box_around_cells, cubic_vertices
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from nerfloom.kernels.table_memory import require
from nerfloom.losses.few_images import FewImagesConfig, decide_few_images
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.losses.terms import COLOR_ERROR, FEW_IMAGES, KNOWN_DISTANCES, SamplerLoss
from nerfloom.samplers.base import SkipsCells
from nerfloom.samplers.choice import SamplingConfig, batch_choice, contracted_box, make_sampler, sampler_choice

BLIND_STEPS = 128
"""Steps before the first update of the occupancy grid: the field is nearly empty then, and would empty all cells."""
FIRST_SIDE, LAST_SIDE = 128, {"vm": 300, "cp": 500}
"""Vertices per axis of the first and the last grid, for a cubic box (section 5)."""
VERTICES_PER_PIXEL = 2
"""Maximum number of vertices per axis, per pixel of the images' longer side; the images do not resolve more."""
MIN_SAMPLES, MAX_SAMPLES, MIN_SAMPLES_SECONDS = 2**13, 2**15, 150.0
"""Samples per training step for short and long times, and the seconds before they grow. On Lego 2^13 and 2^14
samples gave 32.18 and 31.91 dB after 150 s."""
NETWORK_RATE = 1e-3
"""Initial learning rate of the basis and the colour network, the authors'."""
MARGIN = 1
"""Cells of the occupancy grid kept around the occupied ones when the box shrinks."""


@dataclass(frozen=True)
class TensoRFConfig(
    SamplingConfig,
    FewImagesConfig,
    max_num_iterations=30_000,
    learning_rate=2e-2,
    lr_schedule="exponential",
    lr_final=0.1,
    adam_beta2=0.99,
    thin_gradients=0.5,
):
    """Settings of tensorf."""

    RANGES: ClassVar[dict[str, Range]] = {
        "density_components": (1, 2**14),
        "appearance_components": (1, 2**14),
        "first_voxels": (8, 2**30),
        "last_voxels": (8, 2**30),
        "upsample_at": AT_LEAST_0,
        "sparsity": AT_LEAST_0,
        "total_variation": AT_LEAST_0,
        "hidden_width": (1, 2**14),
    }
    GONE: ClassVar[dict[str, Any]] = {"network_learning_rate": NETWORK_RATE}
    decomposition: Literal["vm", "cp"] = "vm"
    """vm: planes and lines. cp: lines only, which take less than 4 MB and learn more slowly."""
    density_components: Auto[int] = AUTO
    """Components of density per group. auto: 16 (vm) or 96 (cp)."""
    appearance_components: Auto[int] = AUTO
    """Components of appearance per group. auto: 48 (vm) or 288 (cp)."""
    first_voxels: Auto[int] = AUTO
    """Vertices of the first grid. auto: 128^3, or fewer if the images do not resolve as many."""
    last_voxels: Auto[int] = AUTO
    """Vertices of the last grid. auto: 300^3 (vm) or 500^3 (cp), or fewer if the images do not resolve as many."""
    upsample_at: tuple[float, ...] = (0.07, 0.1, 0.13, 0.18, 0.23)
    """Fractions of the budget when the grid grows, by equal ratios, and the box shrinks to occupied space."""
    sparsity: float = 8e-5
    """Weight of the mean absolute values of the density factors; halved after the first growth."""
    total_variation: float = 0.0
    """Weight of the total variation of the density factors; appearance has a tenth. Real scenes need 0.01 or more."""
    hidden_width: int = 128
    """Features per hidden layer of the colour network."""
    sparse_updates: bool = True
    """Whether Adam updates only the table entries that a step used."""


class Sparsity(LossTerm):
    """Mean magnitude of the density factors (section 4.4); its weight halves at the first growth."""

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        model = shown.model
        assert isinstance(model, TensoRF)
        factors, share = model.field.density_factors, 0.5 if model.has_grown else 1.0
        bands = factors.bands(factors.all_factors)
        return share * torch.stack([band.abs().mean() for band in bands]).sum()


class TotalVariation(LossTerm):
    """Total variation of the factors (section 4.4); appearance factors have a tenth of the weight."""

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        field = shown.model.field
        assert isinstance(field, TensorField)
        both = field.density_factors, field.appearance_factors
        density, appearance = (factors.variation(factors.all_factors).sum() for factors in both)
        return density + 0.1 * appearance


REGULARISERS = Sparsity("sparsity", "sparsity"), TotalVariation("total_variation", "total_variation")


class TensoRF(RayModel[TensoRFConfig], plain=True):
    """A model with factors that grow from coarse to fine; an occupancy grid also shrinks their box around matter."""

    field: TensorField
    growths: Tensor
    """Number of growths so far."""
    losses = (COLOR_ERROR, SamplerLoss(), *KNOWN_DISTANCES, *REGULARISERS, *FEW_IMAGES)
    steps_repeat = True

    def __init__(self, config: TensoRFConfig, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        self.register_buffer("growths", torch.zeros((), dtype=torch.int64))
        self._growths = HostValue()

    @property
    def has_grown(self) -> bool:
        """True if the grid has grown at least once."""
        return self._growths.of(self.growths) > 0

    def before_step(self, step: int, progress: float) -> None:
        if step >= BLIND_STEPS or not isinstance(self.sampler, SkipsCells):
            super().before_step(step, progress)
        due = sum(progress >= share for share in self._shares())
        if due > self._growths.of(self.growths):
            self.growths.fill_(due)
            self._grow(due / len(self.config.upsample_at))

    def step_kind(self, step: int) -> StepKind:
        kind = super().step_kind(step)
        return replace(kind, of=(*kind.of, self._growths.of(self.growths)))  # the size of the factors

    def _shares(self) -> tuple[float, ...]:
        """Return when the grid grows. With few images, growth ends when other encodings have all levels open."""
        shares, until = self.config.upsample_at, self.config.open_levels_until
        return tuple(until / max(shares) * share for share in shares) if until and any(shares) else shares

    @torch.no_grad()
    def _grow(self, share: float) -> None:
        """Resample the factors over the occupied box, with first^(1 - share) * last^share vertices."""
        voxels = self.config.first_voxels ** (1 - share) * self.config.last_voxels**share
        box, field = self._occupied_box(), self.field
        vertices = cubic_vertices(voxels, box)
        if torch.equal(box, field.box) and vertices == field.density_factors.layout.resolutions[0]:
            return
        size = field.box[1] - field.box[0]
        lower, upper = (box[0] - field.box[0]) / size, (box[1] - field.box[0]) / size
        for factors in (field.density_factors, field.appearance_factors):
            factors.resample((vertices,) * factors.layout.num_groups, lower, upper)
        field.box.copy_(box)

    def _occupied_box(self) -> Tensor:
        """Return corners (2, 3) around all occupied cells with a margin; the field's box if no cell is occupied.

        With nested boxes the field contracts space and keeps its box.
        """
        sampler, box = self.sampler, self.field.box
        if not isinstance(sampler, SkipsCells) or self.field.unbounded:
            return box.clone()
        cells = sampler.occupied.view((sampler.resolution,) * 3)
        around = box_around_cells(cells, sampler.box, MARGIN)
        return box.clone() if around is None else torch.stack([around[0].maximum(box[0]), around[1].minimum(box[1])])


def decide(config: TensoRFConfig, scene: Scene) -> tuple[TensoRFConfig, list[Decision]]:
    """Fill in the settings that depend on the scene and on the resolution of the images."""
    density, appearance = (16, 48) if config.decomposition == "vm" else (96, 288)
    resolved = VERTICES_PER_PIXEL * scene.image_size
    first, last = (min(side, resolved) for side in (FIRST_SIDE, LAST_SIDE[config.decomposition]))
    decomposed = f"the decomposition is {config.decomposition}"
    pixels = f"the images have {scene.image_size} pixels along a side"
    config, sampling = fill(config, sampler_choice(config, scene.unbounded))
    config, made = fill(
        config,
        batch_choice(config, MIN_SAMPLES, MAX_SAMPLES, MIN_SAMPLES_SECONDS),
        Choice("density_components", density, decomposed),
        Choice("appearance_components", appearance, decomposed),
        Choice("first_voxels", first**3, pixels, shown=f"{first}^3"),
        Choice("last_voxels", last**3, pixels, shown=f"{last}^3"),
    )
    config, few = decide_few_images(config, scene)
    return config, sampling + made + few


def make_field(config: TensoRFConfig, scene: Scene) -> TensorField:
    """Return the field with its first, coarsest factors.

    Raises:
        ConfigError: if the last grid needs more memory than the machine has.
    """
    axes = VM if config.decomposition == "vm" else CP
    counts = config.density_components, config.appearance_components
    for voxels in (config.first_voxels, config.last_voxels):  # check both now: the last grid is made late in training
        layout = PlanesLayout.build((cubic_vertices(voxels, scene.box),) * len(axes), axes)
        require(4.0 * layout.num_entries * sum(counts), "a grid")
    vertices = (cubic_vertices(config.first_voxels, scene.box),) * len(axes)
    density, appearance = (
        FeaturePlanes(vertices, count, axes, config.sparse_updates, resizable=True) for count in counts
    )
    unbounded = contracted_box(config, scene) is not None
    field = TensorField(scene.box, density, appearance, config.hidden_width, unbounded=unbounded)
    field.optimised = Optimised("networks", learning_rate=NETWORK_RATE)
    for factors in (density, appearance):
        factors.optimised = Optimised("tables", config.learning_rate, sparse=config.sparse_updates)
        with torch.no_grad():  # CP multiplies three factors, so they start larger, as in the authors' code
            factors.table.normal_(0, 0.1 if config.decomposition == "vm" else 0.2)
    return field


METHOD = Method(
    TensoRFConfig(), paper="arXiv:2203.09517", field=make_field, sampler=make_sampler, model=TensoRF, decide=decide
)
