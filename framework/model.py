"""What the trainer and the evaluator know of a method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor, nn

from framework.base.config import TrainConfig
from framework.data.pixels import Batch
from framework.data.scene import Scene
from framework.encodings.hash_grid import HashGrid
from framework.encodings.planes import FeaturePlanes
from framework.geometry.rays import Rays
from framework.rendering.losses import mean_squared_error
from framework.rendering.volume import Rendered
from framework.samplers.occupancy import OccupancySampler
from framework.samplers.proposal import ProposalSampler, interlevel_loss
from framework.scene.profile import Decision

PROPOSAL_ADAM = {"lr": 1e-2, "betas": (0.9, 0.99), "eps": 1e-15}
"""Of proposals in any method."""

ConfigT = TypeVar("ConfigT", bound=TrainConfig)


class Model(nn.Module, ABC, Generic[ConfigT]):
    """A radiance field that can be trained. `self.training` tells random sampling (True) from fixed (False).

    Args:
        config: the method's settings.
        scene: facts about the data.
    """

    def __init__(self, config: ConfigT, scene: Scene) -> None:
        super().__init__()
        self.config = config
        self.scene = scene

    learns_motion: ClassVar[bool] = False
    """Whether it uses the photographs' times."""
    learns_appearance: ClassVar[bool] = False
    """Whether it can learn that light differs between photographs."""
    refines_poses: ClassVar[bool] = False
    """Whether it can refine the cameras' poses."""

    runs_on_kernels: ClassVar[bool] = False
    """Whether the compiled kernels do its heavy work: then torch's own operations keep to one CPU thread."""

    def decisions(self) -> list[Decision]:
        """What became of the method's options that were left to the data."""
        return []

    @abstractmethod
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Colour, depth and opacity of R rays over `background`, (R, 3) or (3,). R may be 0."""

    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        """Named scalars; their sum is minimised. By default the squared error of every level, and the proposals' loss.

        `rendered` and `batch.rgb` are of pixels. Of several rays a pixel there are as many `batch.rays`, and
        `rendered.samples` and `.weights` are the rays'.
        """
        losses = {"rgb": mean_squared_error(rendered.rgb, batch.rgb, batch.weights)}
        if rendered.coarse is not None:
            losses["rgb_coarse"] = mean_squared_error(rendered.coarse.rgb, batch.rgb, batch.weights)
        if rendered.samples is not None and rendered.samples.proposals and rendered.weights is not None:
            losses["interlevel"] = interlevel_loss(rendered.samples, rendered.weights)
        return losses

    def param_groups(self) -> list[dict[str, Any]]:
        """Adam's parameter groups. Each has `params` and may set `lr`, `betas`, `eps`, `sparse`, `schedule`.

        By default the tables of encodings that ask for it are a group that is updated sparsely.
        """
        grids, groups = self.sparse_grids, self.proposal_groups()
        apart = [grid.table for grid in grids] + [p for group in groups for p in group["params"]]
        rest = [p for p in self.parameters() if not any(p is other for other in apart)]
        groups.insert(0, {"params": rest, "name": "networks"})
        return groups + ([{"params": [g.table for g in grids], "name": "tables", "sparse": True}] if grids else [])

    def proposal_groups(self) -> list[dict[str, Any]]:
        """The group of the proposals' parameters, small hash grids whatever the method is; none without proposals."""
        samplers = [module for module in self.modules() if isinstance(module, ProposalSampler)]
        params = [p for sampler in samplers for p in sampler.parameters()]
        return [{"params": params, "name": "proposals", **PROPOSAL_ADAM}] if params else []

    @cached_property
    def sparse_grids(self) -> list[HashGrid | FeaturePlanes]:
        """Encodings whose tables are updated sparsely."""
        tables = (m for m in self.modules() if isinstance(m, (HashGrid, FeaturePlanes)))
        return [module for module in tables if module.deferred is not None]

    @property
    def occupancy_samplers(self) -> list[OccupancySampler]:
        """The grids that the photographs' silhouettes can empty before the first step."""
        return [module for module in self.modules() if isinstance(module, OccupancySampler)]

    def before_step(self, step: int, progress: float) -> None:
        """Schedules, as functions of the step and of the share of the budget spent, and refreshing of samplers."""

    @property
    def samples_per_batch(self) -> int | None:
        """Samples a training step should evaluate, the number of rays following; None for a fixed number of rays."""
        return self.config.samples_per_batch

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def size(self) -> int:
        """Number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters())


@dataclass(frozen=True)
class Method:
    """A method as its file declares it; its name is the entry point's, its summary the file's first line."""

    model: type[Model[Any]]
    """Built as `model(config, scene)`."""
    config: TrainConfig
    """Default settings."""
    paper: str
    """Where it was published."""
    interface: int = 1
    """The version of the plugin interface it was written for (`registry.INTERFACE`)."""
