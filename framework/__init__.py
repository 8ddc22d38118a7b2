"""Nerfloom: what a method, a data format or a script imports.

Names are imported on use, so that `import framework` costs nothing.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from framework.cameras import Cameras as Cameras
    from framework.config import TrainConfig as TrainConfig
    from framework.dataset import DataParser as DataParser
    from framework.dataset import Dataset as Dataset
    from framework.dataset import ParsedScene as ParsedScene
    from framework.errors import ConfigError as ConfigError
    from framework.errors import DataError as DataError
    from framework.errors import NerfloomError as NerfloomError
    from framework.fields.base import Field as Field
    from framework.model import Method as Method
    from framework.model import Model as Model
    from framework.pixels import Batch as Batch
    from framework.rays import Rays as Rays
    from framework.rays import Samples as Samples
    from framework.renderers import Rendered as Rendered
    from framework.samplers.base import Sampler as Sampler
    from framework.scene import Scene as Scene
    from framework.scene_profile import Decision as Decision

_HOMES = {
    "Batch": "pixels",
    "Cameras": "cameras",
    "ConfigError": "errors",
    "DataError": "errors",
    "DataParser": "dataset",
    "Dataset": "dataset",
    "Decision": "scene_profile",
    "Field": "fields.base",
    "Method": "model",
    "Model": "model",
    "NerfloomError": "errors",
    "ParsedScene": "dataset",
    "Rays": "rays",
    "Rendered": "renderers",
    "Sampler": "samplers.base",
    "Samples": "rays",
    "Scene": "scene",
    "TrainConfig": "config",
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
