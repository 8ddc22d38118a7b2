"""Groups of flags in the help of `ns-train METHOD`: everyday flags first, then by declaring class.

A flag's name does not depend on its group. Settings that a plugin declares are in the method's own group; inherited
settings are in the same group as for every method.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from nerfloom.base.config import AppearanceConfig, RayConfig, RobustConfig, TrainConfig, VectorConfig
from nerfloom.cli.flag_help import plain_flags
from nerfloom.data.parsed_scene import DataParser
from nerfloom.losses.few_images import FewImagesConfig
from nerfloom.samplers.background import BackgroundConfig
from nerfloom.samplers.choice import HierarchicalConfig, SamplingConfig
from nerfloom.samplers.motion import MotionConfig

EVERYDAY = "everyday"
"""Title of the group that `--help` shows; `--help-all` shows all groups."""
OWN = "METHOD"
"""Placeholder of the method's name. Its group has all settings that are in no other group."""
GROUPS: dict[str, tuple[str | type, ...]] = {
    EVERYDAY: (
        "data", "max_seconds", "max_num_iterations", "output_dir", "experiment_name", "rays_per_pixel", "background",
        "masks", "max_train_images", "train_image_indices", "vis", "viewer_share",
    ),
    OWN: (),
    "sampler": (SamplingConfig, HierarchicalConfig),
    "background": (BackgroundConfig,),
    "ray": (RayConfig,),
    "robust": (RobustConfig,),
    "appearance": (AppearanceConfig, VectorConfig),
    "few images": (FewImagesConfig,),
    "motion": (MotionConfig,),
    "teacher": ("teacher", "teacher_share", "teacher_until"),
    "optimisation": (
        "learning_rate", "lr_schedule", "lr_final", "lr_warmup_steps", "adam_beta1", "adam_beta2", "adam_eps",
    ),
    "evaluation and saving": (TrainConfig,),
    "machine": ("cache_limit", "cache_dir", "mixed_precision", "machine", "viewer"),
}  # fmt: skip
"""Titles in order, and the content of each group: settings by name, or all other settings of a class. The data format's
settings come last."""


def grouped_flags(
    method: str, config: TrainConfig, data_format: str, parser: DataParser, everyday: bool = False
) -> ConstructorRegistry:
    """Return tyro's rules that show the flags of a method and a data format in groups.

    Args:
        method: the method's name.
        data_format: the data format's name.
        parser: the data format with its settings.
        everyday: whether the help shows only the everyday flags.
    """
    registry = plain_flags()
    groups = [(method if title == OWN else title, names) for title, names in groups_of(type(config))]
    of_format = [field.name for field in dataclasses.fields(parser)]  # type: ignore[arg-type]
    rules = _divided(registry, config, groups, everyday)
    rules |= _divided(registry, parser, [(f"{data_format} data", of_format)], everyday)
    registry.struct_rule(lambda info: rules.get(info.type))
    return registry


def groups_of(kind: type[TrainConfig]) -> Iterator[tuple[str, list[str]]]:
    """Yield title and settings of each group of a config class `kind`; the first class to declare a setting decides."""
    declared = {
        field.name: next(base for base in reversed(kind.__mro__) if field.name in inspect.get_annotations(base))
        for field in dataclasses.fields(kind)
    }
    listed = {member for members in GROUPS.values() for member in members}
    for title, members in GROUPS.items():
        if title == OWN:
            yield title, [name for name, owner in declared.items() if not {name, owner} & listed]
        else:
            by_class = [name for name, owner in declared.items() if owner in members and name not in listed]
            yield title, [str(member) for member in members if member in declared] + by_class


def _divided(
    registry: ConstructorRegistry, settings: Any, groups: list[tuple[str, list[str]]], everyday: bool
) -> dict[type, StructConstructorSpec]:
    """Return rules that make tyro treat a dataclass as a struct of groups, each a struct of some fields."""
    with registry:
        whole: Any = ConstructorRegistry.get_struct_spec(StructTypeInfo.make(type(settings), settings, False))
    unprefixed = tyro.conf.arg(prefix_name=False)
    flags = {field.name: dataclasses.replace(field, type=Annotated[field.type, unprefixed]) for field in whole.fields}
    rules: dict[type, StructConstructorSpec] = {}
    boxes: list[StructFieldSpec] = []
    for title, names in groups:
        group: Any = type("Group", (), {})
        rules[group] = StructConstructorSpec(dict, tuple(flags[name] for name in names))
        box: Any = Annotated[group, tyro.conf.arg(name=title, help="")]
        if everyday and title != EVERYDAY:
            box = Annotated[box, tyro.conf.Suppress]
        boxes.append(StructFieldSpec(f"{len(boxes)}", box, MISSING_NONPROP))

    def join(**parts: dict[str, Any]) -> Any:
        return whole.instantiate(**{name: value for part in parts.values() for name, value in part.items()})

    rules[type(settings)] = StructConstructorSpec(join, tuple(boxes))
    return rules
