"""Neural radiance fields: the names for notebooks, scripts, methods and data formats.

`process` finds the poses of photographs, `train` trains a method, and `load` loads a run, which renders, evaluates,
measures, and writes videos and exports (docs/notebooks). `edit` has the steps that edit Gaussians. Use the occupancy
grid, sampling and compositing with your own radiance field and training loop (docs/plug-and-play.md). A plugin declares
a `Method` or a `DataParser` (docs/plugins.md).

Names are imported on first use, so that `import nerfloom` is fast.
"""

import importlib as _importlib
import os as _os
import sys as _sys
import typing as _typing

if _typing.TYPE_CHECKING:
    from nerfloom import edit as edit
    from nerfloom.base.config import RayConfig as RayConfig
    from nerfloom.base.config import TrainConfig as TrainConfig
    from nerfloom.base.decisions import Decision as Decision
    from nerfloom.base.errors import ConfigError as ConfigError
    from nerfloom.base.errors import DataError as DataError
    from nerfloom.base.errors import NerfloomError as NerfloomError
    from nerfloom.base.optimised import Optimised as Optimised
    from nerfloom.base.optimised import RowChange as RowChange
    from nerfloom.cameras.cameras import Cameras as Cameras
    from nerfloom.cameras.view import View as View
    from nerfloom.data.dataset import Dataset as Dataset
    from nerfloom.data.parsed_scene import DataParser as DataParser
    from nerfloom.data.parsed_scene import ParsedScene as ParsedScene
    from nerfloom.data.pixels.batch import PixelBatch as PixelBatch
    from nerfloom.data.pixels.batch import ViewBatch as ViewBatch
    from nerfloom.data.scene import Scene as Scene
    from nerfloom.evaluation.paths import look_at as look_at
    from nerfloom.fields.base import Field as Field
    from nerfloom.gaussian_model import GaussianModel as GaussianModel
    from nerfloom.geometry.bounds import contract as contract
    from nerfloom.geometry.bounds import intersect_box as intersect_box
    from nerfloom.geometry.points import Points as Points
    from nerfloom.geometry.rays import Rays as Rays
    from nerfloom.geometry.rays import Samples as Samples
    from nerfloom.kernels.compositing.alpha import composite_alpha as composite_alpha
    from nerfloom.kernels.compositing.density import composite as composite
    from nerfloom.kernels.compositing.density import distortion as distortion
    from nerfloom.kernels.encodings.contraction import contract_to_unit as contract_to_unit
    from nerfloom.kernels.histograms.inverse_cdf import inverse_cdf as inverse_cdf
    from nerfloom.method import Method as Method
    from nerfloom.model import LearnsMotion as LearnsMotion
    from nerfloom.model import Loss as Loss
    from nerfloom.model import Model as Model
    from nerfloom.opened import Opened as Opened
    from nerfloom.plug_and_play.rendering import Rendering as Rendering
    from nerfloom.plug_and_play.rendering import accumulate as accumulate
    from nerfloom.plug_and_play.rendering import render as render
    from nerfloom.plug_and_play.sampling import clip_to_box as clip_to_box
    from nerfloom.plug_and_play.sampling import sample_inverse_cdf as sample_inverse_cdf
    from nerfloom.plug_and_play.sampling import sample_proposals as sample_proposals
    from nerfloom.plug_and_play.sampling import sample_uniform as sample_uniform
    from nerfloom.plug_and_play.skipping import OccupancyGrid as OccupancyGrid
    from nerfloom.plug_and_play.skipping import sample as sample
    from nerfloom.ray_model import RayModel as RayModel
    from nerfloom.renderable import Renderable as Renderable
    from nerfloom.rendering.rendered import Picture as Picture
    from nerfloom.rendering.rendered import Rendered as Rendered
    from nerfloom.rendering.renderer import Renderer as Renderer
    from nerfloom.rendering.volume import VolumeRenderer as VolumeRenderer
    from nerfloom.runs import image as image
    from nerfloom.runs import list_methods as list_methods
    from nerfloom.runs import load as load
    from nerfloom.runs import process as process
    from nerfloom.runs import train as train
    from nerfloom.samplers.base import Sampler as Sampler
    from nerfloom.samplers.proposal import interlevel_loss as interlevel_loss
    from nerfloom.training.loaded import Loaded as Loaded

_HOMES = {
    "Cameras": "cameras.cameras",
    "ConfigError": "base.errors",
    "DataError": "base.errors",
    "DataParser": "data.parsed_scene",
    "Dataset": "data.dataset",
    "Decision": "base.decisions",
    "Field": "fields.base",
    "GaussianModel": "gaussian_model",
    "LearnsMotion": "model",
    "Loaded": "training.loaded",
    "Loss": "model",
    "Method": "method",
    "Model": "model",
    "NerfloomError": "base.errors",
    "OccupancyGrid": "plug_and_play.skipping",
    "Opened": "opened",
    "Optimised": "base.optimised",
    "ParsedScene": "data.parsed_scene",
    "Picture": "rendering.rendered",
    "PixelBatch": "data.pixels.batch",
    "Points": "geometry.points",
    "RayConfig": "base.config",
    "RayModel": "ray_model",
    "Rays": "geometry.rays",
    "Renderable": "renderable",
    "Rendered": "rendering.rendered",
    "Renderer": "rendering.renderer",
    "Rendering": "plug_and_play.rendering",
    "RowChange": "base.optimised",
    "Sampler": "samplers.base",
    "Samples": "geometry.rays",
    "Scene": "data.scene",
    "TrainConfig": "base.config",
    "View": "cameras.view",
    "ViewBatch": "data.pixels.batch",
    "VolumeRenderer": "rendering.volume",
    "accumulate": "plug_and_play.rendering",
    "clip_to_box": "plug_and_play.sampling",
    "composite": "kernels.compositing.density",
    "composite_alpha": "kernels.compositing.alpha",
    "contract": "geometry.bounds",
    "contract_to_unit": "kernels.encodings.contraction",
    "distortion": "kernels.compositing.density",
    "image": "runs",
    "interlevel_loss": "samplers.proposal",
    "intersect_box": "geometry.bounds",
    "inverse_cdf": "kernels.histograms.inverse_cdf",
    "list_methods": "runs",
    "load": "runs",
    "look_at": "evaluation.paths",
    "process": "runs",
    "render": "plug_and_play.rendering",
    "sample": "plug_and_play.skipping",
    "sample_inverse_cdf": "plug_and_play.sampling",
    "sample_proposals": "plug_and_play.sampling",
    "sample_uniform": "plug_and_play.sampling",
    "train": "runs",
}
"""Module that holds each name."""

# By default torch's idle threads spin for milliseconds. On a busy machine that makes training up to four times slower
# than its share of the cores would. GNU's OpenMP reads the first variable (in iterations, about 20 microseconds),
# LLVM's and Intel's read the second (in milliseconds). Both are read when torch is loaded.
if "torch" not in _sys.modules and "OMP_WAIT_POLICY" not in _os.environ:
    _os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    _os.environ.setdefault("KMP_BLOCKTIME", "1")

__version__ = "0.1.0"
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> _typing.Any:
    if name in _HOMES:
        return getattr(_importlib.import_module(f"nerfloom.{_HOMES[name]}"), name)
    if name == "edit":
        return _importlib.import_module("nerfloom.edit")
    raise AttributeError(f"module 'nerfloom' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, "edit", *(name for name in globals() if name.startswith("__"))])
