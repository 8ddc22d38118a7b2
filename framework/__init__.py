"""Nerfloom: what a method, a data format or a script imports.

Names are imported on use, so that `import framework` costs nothing.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from framework.base.config import TrainConfig as TrainConfig
    from framework.base.errors import ConfigError as ConfigError
    from framework.base.errors import DataError as DataError
    from framework.base.errors import NerfloomError as NerfloomError
    from framework.cameras.cameras import Cameras as Cameras
    from framework.data.dataset import DataParser as DataParser
    from framework.data.dataset import Dataset as Dataset
    from framework.data.dataset import ParsedScene as ParsedScene
    from framework.data.pixels import Batch as Batch
    from framework.data.scene import Scene as Scene
    from framework.fields.base import Field as Field
    from framework.geometry.rays import Rays as Rays
    from framework.geometry.rays import Samples as Samples
    from framework.model import Method as Method
    from framework.model import Model as Model
    from framework.rendering.volume import Rendered as Rendered
    from framework.samplers.base import Sampler as Sampler
    from framework.scene.profile import Decision as Decision

_HOMES = {
    "Batch": "data.pixels",
    "Cameras": "cameras.cameras",
    "ConfigError": "base.errors",
    "DataError": "base.errors",
    "DataParser": "data.dataset",
    "Dataset": "data.dataset",
    "Decision": "scene.profile",
    "Field": "fields.base",
    "Method": "model",
    "Model": "model",
    "NerfloomError": "base.errors",
    "ParsedScene": "data.dataset",
    "Rays": "geometry.rays",
    "Rendered": "rendering.volume",
    "Sampler": "samplers.base",
    "Samples": "geometry.rays",
    "Scene": "data.scene",
    "TrainConfig": "base.config",
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
