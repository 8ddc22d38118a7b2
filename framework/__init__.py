"""Nerfloom: what a method, a data format or a script imports.

Names are imported on use, so that `import framework` costs nothing.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from framework.base.config import RayConfig as RayConfig
    from framework.base.config import TrainConfig as TrainConfig
    from framework.base.decisions import Decision as Decision
    from framework.base.errors import ConfigError as ConfigError
    from framework.base.errors import DataError as DataError
    from framework.base.errors import NerfloomError as NerfloomError
    from framework.base.optimised import Optimised as Optimised
    from framework.base.optimised import RowChange as RowChange
    from framework.cameras.cameras import Cameras as Cameras
    from framework.cameras.view import View as View
    from framework.data.dataset import Dataset as Dataset
    from framework.data.parsed_scene import DataParser as DataParser
    from framework.data.parsed_scene import ParsedScene as ParsedScene
    from framework.data.pixels import PixelBatch as PixelBatch
    from framework.data.pixels import ViewBatch as ViewBatch
    from framework.data.scene import Scene as Scene
    from framework.fields.base import Field as Field
    from framework.gaussian_model import GaussianModel as GaussianModel
    from framework.geometry.points import Points as Points
    from framework.geometry.rays import Rays as Rays
    from framework.geometry.rays import Samples as Samples
    from framework.method import Method as Method
    from framework.model import LearnsMotion as LearnsMotion
    from framework.model import Loss as Loss
    from framework.model import Model as Model
    from framework.ray_model import RayModel as RayModel
    from framework.rendering.rendered import Picture as Picture
    from framework.rendering.rendered import Rendered as Rendered
    from framework.rendering.renderer import Renderer as Renderer
    from framework.rendering.volume import VolumeRenderer as VolumeRenderer
    from framework.samplers.base import Sampler as Sampler

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
    "Loss": "model",
    "Method": "method",
    "Model": "model",
    "NerfloomError": "base.errors",
    "Optimised": "base.optimised",
    "ParsedScene": "data.parsed_scene",
    "Picture": "rendering.rendered",
    "PixelBatch": "data.pixels",
    "Points": "geometry.points",
    "RayConfig": "base.config",
    "RayModel": "ray_model",
    "Rays": "geometry.rays",
    "Rendered": "rendering.rendered",
    "Renderer": "rendering.renderer",
    "RowChange": "base.optimised",
    "Sampler": "samplers.base",
    "Samples": "geometry.rays",
    "Scene": "data.scene",
    "TrainConfig": "base.config",
    "View": "cameras.view",
    "ViewBatch": "data.pixels",
    "VolumeRenderer": "rendering.volume",
}

# Threads of torch's that wait look out for work for milliseconds, unless told otherwise before torch is loaded. Beside
# another program that uses up the time in which they could work: a training is four times slower than its share of the
# cores would make it. The first is for GNU's OpenMP (in rounds, some 20 microseconds), the other for LLVM's and Intel's
# (in milliseconds).
if "torch" not in sys.modules and "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    os.environ.setdefault("KMP_BLOCKTIME", "1")

__version__ = "0.1.0"
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"framework.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'framework' has no attribute '{name}'")
