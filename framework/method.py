"""A method as its file declares it: a model's parts, settings, and what is decided by the data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from framework.base.config import TrainConfig
from framework.base.decisions import Decision
from framework.base.errors import ConfigError
from framework.data.scene import Scene
from framework.fields.base import Field
from framework.model import Model
from framework.ray_model import RayModel
from framework.rendering.renderer import Renderer
from framework.rendering.volume import VolumeRenderer
from framework.samplers.base import Sampler


def nothing_to_decide(config: Any, scene: Scene) -> tuple[Any, list[Decision]]:
    """Return the settings as they are.

    Args:
        config: a method's settings.
        scene: facts about the data.
    """
    return config, []


def volume_renderer(config: Any, scene: Scene) -> Renderer:
    """Return the renderer of most methods.

    Args:
        config: a method's settings.
        scene: facts about the data.
    """
    return VolumeRenderer()


@dataclass(frozen=True)
class Method:
    """A method as its file declares it; its name is the entry point's, its summary the file's first line.

    One that casts rays names its field, sampler and renderer, each a function of settings and scene; a plugin exchanges
    one of them by `dataclasses.replace(METHOD, renderer=...)`. One that draws whole images names its model alone.
    """

    config: TrainConfig
    """Default settings."""
    paper: str
    """Where it was published."""
    field: Callable[[Any, Scene], Field] | None = None
    """Makes the field that is sampled; None of a method that casts no rays."""
    sampler: Callable[[Any, Scene], Sampler] | None = None
    """Makes what says where the field is asked."""
    renderer: Callable[[Any, Scene], Renderer] = volume_renderer
    """Makes what turns samples into colours and depths."""
    model: type[Model[Any]] = RayModel
    """Built as `model(config, scene, field, sampler, renderer)`, or, without a field, as `model(config, scene)`."""
    decide: Callable[[Any, Scene], tuple[Any, list[Decision]]] = nothing_to_decide
    """Fills in the settings that were left to the data, and says why (`framework.base.decisions.fill`)."""
    interface: int = 2
    """The version of the plugin interface it was written for (`registry.INTERFACE`)."""

    def build(self, config: TrainConfig, scene: Scene) -> Model[Any]:
        """Return the model with fresh parameters.

        Args:
            config: settings, decided or not.
            scene: facts about the data.
        Raises: ConfigError where settings do not fit the scene or each other.
        """
        config, _ = self.decide(config, scene)
        if self.field is None:
            return self.model(config, scene)
        if self.sampler is None or not issubclass(self.model, RayModel):
            raise ConfigError(f"a method with a field needs a sampler and a RayModel, not {self.model.__name__}")
        field = self.field(config, scene)
        return self.model(config, scene, field, self.sampler(config, scene), self.renderer(config, scene))
