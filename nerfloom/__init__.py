"""The Python interface of Nerfloom, for notebooks and scripts.

`load` loads a run, to render its views and evaluate it, and `train` trains another (docs/notebooks). For your own
radiance field and training loop (docs/plug-and-play.md) there are an occupancy grid, sampling and compositing. Names
are imported when they are used, so that `import nerfloom` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from framework import __version__ as __version__  # before torch: it tells torch's threads not to spin

if TYPE_CHECKING:
    from framework.cameras.cameras import Cameras as Cameras
    from framework.cameras.view import View as View
    from framework.geometry.bounds import contract as contract
    from framework.geometry.bounds import intersect_box as intersect_box
    from framework.geometry.rays import Rays as Rays
    from framework.geometry.rays import Samples as Samples
    from framework.kernels.alpha import composite_alpha as composite_alpha
    from framework.kernels.compositing import composite as composite
    from framework.kernels.compositing import distortion as distortion
    from framework.kernels.contraction import contract_to_unit as contract_to_unit
    from framework.samplers.inverse_cdf import inverse_cdf as inverse_cdf
    from framework.samplers.proposal import interlevel_loss as interlevel_loss
    from nerfloom.rendering import Rendering as Rendering
    from nerfloom.rendering import accumulate as accumulate
    from nerfloom.rendering import render as render
    from nerfloom.runs import TrainedRun as TrainedRun
    from nerfloom.runs import image as image
    from nerfloom.runs import load as load
    from nerfloom.runs import methods as methods
    from nerfloom.runs import train as train
    from nerfloom.sampling import clip_to_box as clip_to_box
    from nerfloom.sampling import sample_inverse_cdf as sample_inverse_cdf
    from nerfloom.sampling import sample_proposals as sample_proposals
    from nerfloom.sampling import sample_uniform as sample_uniform
    from nerfloom.skipping import OccupancyGrid as OccupancyGrid
    from nerfloom.skipping import sample as sample

_HOMES = {
    "Cameras": "framework.cameras.cameras",
    "OccupancyGrid": "nerfloom.skipping",
    "Rays": "framework.geometry.rays",
    "Rendering": "nerfloom.rendering",
    "Samples": "framework.geometry.rays",
    "TrainedRun": "nerfloom.runs",
    "View": "framework.cameras.view",
    "accumulate": "nerfloom.rendering",
    "clip_to_box": "nerfloom.sampling",
    "composite": "framework.kernels.compositing",
    "composite_alpha": "framework.kernels.alpha",
    "contract": "framework.geometry.bounds",
    "contract_to_unit": "framework.kernels.contraction",
    "distortion": "framework.kernels.compositing",
    "image": "nerfloom.runs",
    "interlevel_loss": "framework.samplers.proposal",
    "intersect_box": "framework.geometry.bounds",
    "inverse_cdf": "framework.samplers.inverse_cdf",
    "load": "nerfloom.runs",
    "methods": "nerfloom.runs",
    "render": "nerfloom.rendering",
    "sample": "nerfloom.skipping",
    "sample_inverse_cdf": "nerfloom.sampling",
    "sample_proposals": "nerfloom.sampling",
    "sample_uniform": "nerfloom.sampling",
    "train": "nerfloom.runs",
}
"""Module from which each name is imported."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'nerfloom' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
