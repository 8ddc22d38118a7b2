"""Names of what ns-render can show of a view; without torch, for the command line."""

from __future__ import annotations

from typing import Literal

OutputName = Literal["rgb", "depth", "median_depth", "accumulation", "normals", "error", "gt-rgb"]
