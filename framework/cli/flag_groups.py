"""Groups of flags in the help of `ns-train METHOD`: the most used first, then by the class that declares a setting.

A flag's name does not depend on its group. Settings that a plugin declares are in the method's own group; settings that
it inherits are in the same group as for every method.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from nerfloom.base.config import AUTO, LEFT_TO_DATA, AppearanceConfig, RayConfig, TrainConfig
from nerfloom.base.errors import ConfigError
from nerfloom.cli.flag_text import hide_none, plain
from nerfloom.data.dataset import DataParser
from nerfloom.losses.few_images import FewImagesConfig
from nerfloom.samplers.background import BackgroundConfig
from nerfloom.samplers.choice import HierarchicalConfig, SamplingConfig
from nerfloom.scene.motion import MotionConfig

OWN = "METHOD"
"""Placeholder of the method's name, whose group has all settings that no other group has."""
GROUPS: dict[str, tuple[str | type, ...]] = {
    "everyday": (
        "data", "max_seconds", "max_num_iterations", "output_dir", "experiment_name", "rays_per_pixel", "background",
        "masks", "max_train_images", "train_image_indices", "vis", "viewer_share",
    ),
    OWN: (),
    "sampler": (SamplingConfig, HierarchicalConfig),
    "background": (BackgroundConfig,),
    "ray": (RayConfig,),
    "appearance": (AppearanceConfig,),
    "few images": (FewImagesConfig,),
    "motion": (MotionConfig,),
    "optimisation": (
        "learning_rate", "lr_schedule", "lr_final", "lr_warmup_steps", "adam_beta1", "adam_beta2", "adam_eps",
    ),
    "evaluation and saving": (TrainConfig,),
    "machine": ("cache_limit", "cache_dir", "mixed_precision", "machine", "viewer"),
}  # fmt: skip
"""Titles in their order, and what each group holds: settings by name, or all others of a class. The data format's
settings come last."""
DECIDED = "(default: decided by the data)"


class RefusedSettings(Exception):
    """Settings whose values cannot be.

    It is no ValueError, which tyro would put into a box, without the line that says what to do.
    """


def grouped_flags(method: str, config: TrainConfig, data_format: str, parser: DataParser) -> ConstructorRegistry:
    """Return rules with which tyro shows the flags of a method and of a data format in groups.

    With these rules `tyro.cli` raises RefusedSettings where a value is out of range.

    Args:
        method: the method's name.
        config: the method's settings.
        data_format: the data format's name.
        parser: the data format with its settings.
    """
    rules: dict[type, StructConstructorSpec] = {}
    _divide(rules, config, [(method if title == OWN else title, names) for title, names in groups_of(type(config))])
    of_format = [field.name for field in dataclasses.fields(parser)]  # type: ignore[arg-type]
    _divide(rules, parser, [(f"{data_format} data", of_format)])
    registry = ConstructorRegistry()
    registry.struct_rule(lambda info: rules.get(info.type))
    hide_none(registry)
    return registry


def groups_of(kind: type[TrainConfig]) -> Iterator[tuple[str, list[str]]]:
    """Yield the title and the settings of each group; a setting belongs to the first class that declares it.

    Args:
        kind: the class of a method's settings.
    """
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


def _divide(rules: dict[type, StructConstructorSpec], settings: Any, groups: list[tuple[str, list[str]]]) -> None:
    """Add rules with which tyro treats a dataclass as a struct of groups, each a struct of some of its fields."""
    whole: Any = ConstructorRegistry.get_struct_spec(StructTypeInfo.make(type(settings), settings, False))
    flags = {field.name: _flag(field) for field in whole.fields}
    for field in whole.fields:
        if dataclasses.is_dataclass(field.default) and not isinstance(field.default, type):
            kind = type(field.default)
            nested: Any = ConstructorRegistry.get_struct_spec(StructTypeInfo.make(kind, field.default, False))
            flags_of_it = tuple(map(plain, nested.fields))
            rules[kind] = dataclasses.replace(nested, fields=flags_of_it, instantiate=_checked(nested.instantiate))
    boxes = []
    for index, (title, names) in enumerate(groups):
        group = type("Group", (), {})
        rules[group] = StructConstructorSpec(dict, tuple(flags[name] for name in names))
        annotated: Any = Annotated[group, tyro.conf.arg(name=title, help="")]
        boxes.append(StructFieldSpec(f"{index}", annotated, MISSING_NONPROP))

    def join(**parts: dict[str, Any]) -> Any:
        return _checked(whole.instantiate)(**{name: value for part in parts.values() for name, value in part.items()})

    rules[type(settings)] = StructConstructorSpec(join, tuple(boxes))


def _checked(make: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that makes settings by `make`, and raises RefusedSettings for a ConfigError."""

    def made(**values: Any) -> Any:
        try:
            return make(**values)
        except ConfigError as error:
            raise RefusedSettings(str(error)) from error

    return made


def _flag(field: StructFieldSpec) -> StructFieldSpec:
    """Return a field whose flag has no prefix, and whose default is said to depend on the data if it does."""
    is_open = field.default == AUTO and LEFT_TO_DATA in getattr(field.type, "__metadata__", ())
    return plain(field, prefix_name=False, **{"help_behavior_hint": DECIDED} if is_open else {})
