"""Choice of a method's renderer."""

from __future__ import annotations

from nerfloom.base.config import RayConfig
from nerfloom.data.scene import Scene
from nerfloom.rendering.reflections import ReflectionRenderer
from nerfloom.rendering.volume import VolumeRenderer, scaled_up_to


def volume_renderer(config: RayConfig, scene: Scene) -> VolumeRenderer:
    """Return the renderer of most methods, with gradient scaling near cameras and thinning from the settings.

    If colours depend on reflected directions (`--directional`), pictures also have their parts.
    """
    kind = ReflectionRenderer if config.directional == "reflected" else VolumeRenderer
    return kind(scaled_up_to(config, scene), config.thin_gradients)
