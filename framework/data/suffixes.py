"""Suffixes of image and video files."""

from __future__ import annotations

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif", ".avif", ".jp2", ".jfif")
"""Suffixes of image files."""
HEIF_SUFFIXES = (".heic", ".heif")
"""Suffixes of images that Pillow reads only with the package pillow-heif."""
UNREAD_SUFFIXES = (
    ".jxl",
    ".gif",
    ".exr",
    ".hdr",
    ".psd",
    ".dng",
    ".cr2",
    ".cr3",
    ".nef",
    ".arw",
    ".orf",
    ".raf",
    ".rw2",
)
"""Suffixes of image files that are not read, and counted where they are left out."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
"""Suffixes of video files."""
