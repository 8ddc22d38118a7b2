"""Advice on installing optional packages, by their own names, which pip finds from a clone as well."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

EXTRAS: dict[str, dict[str, str]] = {
    "video": {"imageio_ffmpeg": "'imageio[ffmpeg]'"},
    "plots": {"matplotlib": "matplotlib"},
    "lpips": {"lpips": "lpips", "torchvision": "torchvision"},
}
"""Extra of pyproject.toml -> the module that is imported, and what pip calls its package."""


def missing(extra: str) -> str | None:
    """How to install what an extra lacks, as in "pip install lpips torchvision"; None where everything is there."""
    absent = [package for module, package in EXTRAS[extra].items() if find_spec(module) is None]
    return f"pip install {' '.join(absent)}" if absent else None


def reinstall() -> str:
    """How to install this package once more, with its kernels built."""
    root = Path(__file__).resolve().parents[2]
    return f"pip install -e {root}" if (root / "setup.py").is_file() else "pip install --force-reinstall nerfloom"
