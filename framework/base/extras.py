"""Commands that install optional packages. They name the packages themselves, so that they also work in a clone."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from nerfloom.base.errors import ConfigError

EXTRAS: dict[str, dict[str, str]] = {
    "video": {"imageio_ffmpeg": "'imageio[ffmpeg]'"},
    "plots": {"matplotlib": "matplotlib"},
    "viewer": {"viser": "viser"},
    "export": {"skimage": "scikit-image", "trimesh": "trimesh", "fast_simplification": "fast-simplification"},
    "lpips": {"lpips": "lpips", "torchvision": "torchvision"},
    "cluster": {"ray": "ray"},
    "heic": {"pillow_heif": "pillow-heif"},
    "spz": {"zstandard": "zstandard"},
}
"""Extra in pyproject.toml -> {imported module: name of its package for pip}."""


def install_command(extra: str) -> str | None:
    """Return the command that installs the missing packages of an extra.

    Args:
        extra: a key of `EXTRAS`.

    Returns:
        A command such as "pip install lpips torchvision", or None if every package is installed.
    """
    absent = [package for module, package in EXTRAS[extra].items() if find_spec(module) is None]
    return f"pip install {' '.join(absent)}" if absent else None


def require(extra: str, what: str, otherwise: str = "") -> None:
    """Check that the packages of an extra are installed.

    Args:
        extra: a key of `EXTRAS`.
        what: beginning of the message, such as "a mesh needs".
        otherwise: end of the message, such as "; or take another format".

    Raises:
        ConfigError: with the command that installs them.
    """
    if (advice := install_command(extra)) is not None:
        raise ConfigError(f"{what} packages that are not installed: {advice}{otherwise}")


def reinstall_command() -> str:
    """Return the command that reinstalls this package and builds its kernels."""
    root = Path(__file__).resolve().parents[2]
    return f"pip install -e {root}" if (root / "setup.py").is_file() else "pip install --force-reinstall nerfloom"
