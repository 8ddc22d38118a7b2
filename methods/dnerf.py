"""D-NeRF: a canonical radiance field and a network that deforms it over time; T-NeRF as its option.

Pumarola et al., "D-NeRF: Neural Radiance Fields for Dynamic Scenes", CVPR 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torch import Tensor

from framework import Decision, Field, Method, Model, Rays, Rendered, Scene
from framework.base.config import AT_LEAST_0, Range
from framework.encodings.hash_grid import HashGrid
from framework.fields.deformed import DeformedField
from framework.fields.encoded import EncodedField
from framework.fields.nerf import NeRFField
from framework.kernels.frequency import MAX_FREQUENCIES
from framework.kernels.hash_grid import MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from framework.rendering.volume import render_field, render_hierarchical
from framework.samplers.choice import (
    HierarchicalConfig,
    chosen_sampler,
    contracted_box,
    make_sampler,
    sampler_decisions,
)
from framework.samplers.occupancy import OccupancySampler
from methods.vanilla_nerf import OCCUPANCY_RATE, OCCUPANCY_SAMPLES_PER_BATCH

HASH_SAMPLES_PER_BATCH = 2**14
"""With a hash grid the networks are small, and a step can hold more samples."""


@dataclass(frozen=True)
class DNeRFConfig(HierarchicalConfig):
    """Settings of dnerf; networks, samples and learning rate are the paper's.

    Unlike there, photographs with alpha are composited over random colours in training: over white, a scene with much
    white in white in it is learnt as empty space, and stays so.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "num_layers": (3, 64),
        "hidden_width": (2, 2**14),
        "deformation_layers": (1, 64),
        "deformation_width": (1, 2**14),
        "position_frequencies": (0, MAX_FREQUENCIES),
        "direction_frequencies": (0, MAX_FREQUENCIES),
        "time_frequencies": (0, MAX_FREQUENCIES),
        "grid_learning_rate": AT_LEAST_0,
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
    }
    """What these numbers may be."""
    max_num_iterations: int = 800_000
    num_rays_per_batch: int = 2_048
    learning_rate: float = 5e-4
    lr_final: float = 0.1
    adam_eps: float = 1e-7
    variant: Literal["d-nerf", "t-nerf"] = "d-nerf"
    """d-nerf: a canonical field, deformed. t-nerf: one network of place and time."""
    canonical: Literal["network", "hash-grid"] = "network"
    """What d-nerf deforms: the paper's network, or a hash grid with small networks."""
    num_layers: int = 8
    """Layers of the canonical network before density."""
    hidden_width: int = 256
    """Features of a layer of the canonical network."""
    deformation_layers: int | None = None
    """Hidden layers of the deformation network. If not given: 8, or 4 with a hash grid."""
    deformation_width: int | None = None
    """Features of a layer of the deformation network. If not given: 256, or 64 with a hash grid."""
    position_frequencies: int = 10
    """L of the position's encoding."""
    direction_frequencies: int = 4
    """L of the direction's encoding."""
    time_frequencies: int = 4
    """L of the time's encoding."""
    grid_learning_rate: float = 1e-2
    """Of the hash grid and the two networks that read it."""
    max_resolution: int = 512
    """Cells along an axis at the hash grid's finest level."""
    log2_table_size: int = 16
    """Entries of a level's table at most, as a power of two."""
    sparse_updates: bool = True
    """Adam updates only the entries of the hash grid that a step used."""
    grid_resolution: int = 64
    """Cells along an axis of the occupancy grid. A cell is occupied if it is at any time."""
    num_steps: int | None = 192
    """Steps along the box's diagonal with the occupancy grid."""


class DNeRF(Model[DNeRFConfig]):
    """A deformed field, or one of place and time. Without times, the canonical field alone."""

    runs_on_kernels = True
    learns_motion = True

    def __init__(self, config: DNeRFConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.contracted_box = contracted_box(config, scene)
        hierarchical = chosen_sampler(config, scene) == "hierarchical"
        self.fine = self._field()
        self.coarse = self._field() if hierarchical else None
        self.sampler = None if hierarchical else make_sampler(config, scene)

    def _field(self) -> Field:
        c, moving = self.config, self.scene.moving
        small = c.canonical == "hash-grid"
        if moving and c.variant == "t-nerf":
            return self._network(c.time_frequencies)
        if small:
            grid = HashGrid(max_resolution=c.max_resolution, log2_table_size=c.log2_table_size, sparse=c.sparse_updates)
            canonical: Field = EncodedField(self.scene.box, grid, unbounded=self.contracted_box is not None)
        else:
            canonical = self._network(None)
        if not moving:
            return canonical
        width, layers = (64, 4) if small else (256, 8)
        return DeformedField(
            canonical,
            c.deformation_width or width,
            c.deformation_layers or layers,
            c.position_frequencies,
            c.time_frequencies,
            self.contracted_box,
        )

    def _network(self, time_frequencies: int | None) -> NeRFField:
        c = self.config
        skip = c.num_layers // 2 + 1
        frequencies = c.position_frequencies, c.direction_frequencies
        return NeRFField(c.hidden_width, c.num_layers, skip, *frequencies, time_frequencies, self.contracted_box)

    def decisions(self) -> list[Decision]:
        found = sampler_decisions(self.config, self.scene)
        if not self.scene.moving:
            found.append(Decision("deformation", "left out", "the photographs have no times"))
        return found

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        if self.sampler is not None:
            return render_field(self.fine, self.sampler, rays, background, self.training)
        assert self.coarse is not None
        counts = self.config.num_coarse_samples, self.config.num_fine_samples
        return render_hierarchical(self.coarse, self.fine, rays, background, counts, self.training)

    def param_groups(self) -> list[dict[str, Any]]:
        config = self.config
        faster = OCCUPANCY_RATE if isinstance(self.sampler, OccupancySampler) else 1.0
        encoded = [module for module in self.modules() if isinstance(module, EncodedField)]
        proposals = self.proposal_groups()
        apart = {id(p) for module in encoded for p in module.parameters()}
        apart |= {id(p) for group in proposals for p in group["params"]}
        rest = [p for p in self.parameters() if id(p) not in apart]
        groups: list[dict[str, Any]] = [{"params": rest, "lr": config.learning_rate * faster, "name": "networks"}]
        if encoded:
            tables = [module.encoding.table for module in encoded]
            heads = [p for m in encoded for p in m.parameters() if not any(p is table for table in tables)]
            faithful = {"lr": config.grid_learning_rate, "betas": (0.9, 0.95), "eps": 1e-15}
            groups += [{"params": heads, "name": "heads", **faithful}]
            groups += [{"params": tables, "name": "tables", "sparse": config.sparse_updates, **faithful}]
        return [group for group in groups if group["params"]] + proposals

    @property
    def samples_per_batch(self) -> int | None:
        if not isinstance(self.sampler, OccupancySampler) or self.config.samples_per_batch is not None:
            return self.config.samples_per_batch
        small = self.config.canonical == "hash-grid" and self.config.variant == "d-nerf"
        return HASH_SAMPLES_PER_BATCH if small else OCCUPANCY_SAMPLES_PER_BATCH

    def before_step(self, step: int, progress: float) -> None:
        if self.sampler is not None:
            self.sampler.update(step, self.fine.density)


METHOD = Method(DNeRF, DNeRFConfig(), paper="arXiv:2011.13961")
