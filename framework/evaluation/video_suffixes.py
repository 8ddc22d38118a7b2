"""Suffixes of videos and animations, without numpy, so that a wrong suffix is refused at once."""

from __future__ import annotations

from pathlib import Path

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.extras import install_command

VIDEO, ANIMATIONS = ".mp4", (".gif", ".webp", ".png")
"""Suffixes of files with several pictures."""
MAX_GIF_FPS = 50.0
"""Maximum number of frames per second of a GIF. Browsers show a frame of less than 0.02 s for 0.1 s."""


def default_video(stem: str) -> Path:
    """Return the name of a video: `stem`.mp4 if MP4 can be written, else `stem`.gif."""
    return Path(f"{stem}{VIDEO}" if install_command("video") is None else f"{stem}.gif")


def check_suffix(path: Path) -> None:
    """Refuse, before rendering, a file `path` that cannot be written; without suffix it is a folder.

    Raises:
        ConfigError: for an unknown suffix, or for MP4 if ffmpeg is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in ("", VIDEO, *ANIMATIONS):
        known = ", ".join((VIDEO, *ANIMATIONS))
        raise FlagError(f"--output-path {path}: the extension must be {known}, or none for a folder of images")
    if suffix == VIDEO and (advice := install_command("video")) is not None:
        raise ConfigError(
            f"--output-path {path}: MP4 needs ffmpeg, the extra [video]: {advice}; or name a .gif, a .webp or a folder"
        )
