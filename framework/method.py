"""Declaration of a method: the parts of its model, its settings, and decisions that depend on the data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from nerfloom.base.config import TrainConfig
from nerfloom.base.decisions import Choice, Decision, fill, left_open
from nerfloom.base.errors import ConfigError, is_out_of_memory
from nerfloom.data.scene import Scene
from nerfloom.fields.base import Field
from nerfloom.model import Model
from nerfloom.ray_model import RayModel
from nerfloom.renderable import RendersFromImages
from nerfloom.rendering.choice import volume_renderer
from nerfloom.rendering.renderer import Renderer
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.choice import sampler_choice

DEPTH_REASONS = {True: "there are depth images", False: "there are no depth images"}
"""Reason for or against a depth loss, by whether there are depth images."""
DEPTH = 0.1
"""Default weight of the depth loss with depth images."""
SPARSE_DEPTH = 0.001
"""Default weight of the depth loss with points of a reconstruction."""
LIGHT_REASONS = {True: "light differs between the images", False: "the images are lit alike"}
"""Reason for or against an appearance of each image, by whether light, exposure or camera differ."""
SHARED_BY = 2
"""Default of `rays_shared_by` in unbounded scenes, unless it would cut anything off."""


def nothing_to_decide(config: Any, scene: Scene) -> tuple[Any, list[Decision]]:
    """Return the settings `config` unchanged and no decisions: the default of `Method.decide`."""
    return config, []


def depth_choice(scene: Scene) -> Choice:
    """Return the weight of the depth loss that suits the scene."""
    points = scene.num_sparse_depths > 0 and not scene.has_depth
    weight = SPARSE_DEPTH if points else DEPTH if scene.has_depth else 0.0
    seen = f"the reconstruction's points are seen in {scene.num_sparse_depths:,} pixels"
    reason = seen if points else DEPTH_REASONS[scene.has_depth]
    return Choice("depth_loss_mult", weight, reason, "depth loss")


def appearance_choice(config: TrainConfig, scene: Scene) -> Choice:
    """Return the kind of appearance that suits the scene: the method's `changing_light` if light differs, else none.

    Args:
        config: the method's settings.
        scene: facts about the data.
    """
    kind = config.changing_light if scene.appearance_varies else "none"
    return Choice("appearance", kind, "" if config.changing_light == "none" else LIGHT_REASONS[scene.appearance_varies])


@dataclass(frozen=True)
class Method:
    """Declaration of a method. The first line of its file is its summary.

    A method that casts rays declares a field, a sampler and a renderer, each as a function of settings and scene. A
    plugin replaces one of them with `dataclasses.replace(METHOD, renderer=...)`. A method that draws whole images
    declares only a model.
    """

    config: TrainConfig
    """Default settings."""
    paper: str
    """Publication that describes the method."""
    field: Callable[[Any, Scene], Field] | None = None
    """Creates the field from settings and scene; None for a method that casts no rays."""
    sampler: Callable[[Any, Scene], Sampler] | None = None
    """Creates the sampler, which chooses where the field is evaluated."""
    renderer: Callable[[Any, Scene], Renderer] = volume_renderer
    """Creates the renderer, which turns samples into colours and depths."""
    model: type[Model[Any]] = RayModel
    """Class of the model: called with (config, scene, field, sampler, renderer), or (config, scene) without a field."""
    decide: Callable[[Any, Scene], tuple[Any, list[Decision]]] = nothing_to_decide
    """Fills in the settings that depend on the data, with reasons (`nerfloom.base.decisions.fill`)."""
    interface: int = 3
    """Version of the plugin interface that the method was written for (`registry.INTERFACE`)."""
    name: str = "unnamed"
    """Registered name, from the entry point; set when the method is loaded."""

    def decided(self, config: Any, scene: Scene) -> tuple[Any, list[Decision]]:
        """Return the settings with all open ones decided, first by the method, then by rules for all methods.

        Args:
            config: the method's settings.

        Returns:
            The settings and the decisions.

        Raises:
            ConfigError: if a setting is still open.
        """
        config, made = self.decide(config, scene)
        undecided = left_open(config)
        for rule in (
            depth_choice(scene),
            appearance_choice(config, scene),
            Choice("robust", "off", ""),  # from images alone, by `training/robust_choice.py`
            Choice("rays_shared_by", SHARED_BY if scene.unbounded else 0, ""),
            Choice("samples_per_batch", None, "steps have a number of rays"),
            sampler_choice(config, scene.unbounded),
        ):
            config, more = fill(config, *[rule] * (rule.setting in undecided))
            made = made + more * bool(rule.value and rule.reason)  # do not report a weight of 0
        for name in left_open(config):
            flag, value = name.replace("_", "-"), getattr(config, name)
            raise ConfigError(f"--{flag} is {value}, and this method does not decide it; give a value")
        return config, made

    def build(self, config: TrainConfig, scene: Scene) -> Model[Any]:
        """Return the model for `config`, with open settings decided first, and new parameters.

        Raises:
            ConfigError: if the settings do not fit the scene or each other, if the model does not fit into memory, or
                if the method cannot learn such data: several scenes, a scene without an end, or light that differs.
        """
        if scene.num_scenes > 1 and not issubclass(self.model, RendersFromImages):
            raise ConfigError(
                f"the data shows {scene.num_scenes} scenes, and {self.name} learns one: choose a method that learns "
                "several, such as pixel-nerf, or data of one scene"
            )
        if scene.unbounded and self.model.ends_at_box:
            raise ConfigError(
                f"{self.name} learns what is in a box, and this scene extends beyond its box: take a method for "
                "captures, such as gaussian-splatting or nerfacto"
            )
        try:
            model = self._built(config, scene)
        except (MemoryError, RuntimeError) as error:
            if not is_out_of_memory(error):
                raise
            raise ConfigError(
                f"the model of {self.name} does not fit into memory with these settings; make it smaller"
            ) from error
        if model.appearance is None and model.config.appearance != "none":
            raise ConfigError(
                f"--appearance is {model.config.appearance}, and {self.name} learns one light for all images: take none"
            )
        return model

    def _built(self, config: TrainConfig, scene: Scene) -> Model[Any]:
        config, _ = self.decided(config, scene)
        if self.field is None:
            return self.model(config, scene)
        if self.sampler is None or not issubclass(self.model, RayModel):
            raise ConfigError(f"a method with a field needs a sampler and a RayModel, not {self.model.__name__}")
        field = self.field(config, scene)
        return self.model(config, scene, field, self.sampler(config, scene), self.renderer(config, scene))
