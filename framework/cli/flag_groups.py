"""Groups of flags in the help of `ns-train METHOD`: the everyday ones first, then by the class that declares a setting.

A flag's name does not depend on its group. What a plugin declares is its method's own group; what it inherits stands
where it stands for every method.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from framework.base.config import LEFT_TO_DATA, AppearanceConfig, RayConfig, TrainConfig
from framework.data.dataset import DataParser
from framework.samplers.choice import HierarchicalConfig, SamplingConfig

OWN = "METHOD"
"""Stands for the method's name; its group holds what no other does."""
GROUPS: dict[str, tuple[str | type, ...]] = {
    "everyday": (
        "data", "max_seconds", "max_num_iterations", "output_dir", "experiment_name", "rays_per_pixel", "background",
        "masks", "vis",
    ),
    OWN: (),
    "sampler": (SamplingConfig, HierarchicalConfig),
    "ray": (RayConfig,),
    "appearance": (AppearanceConfig,),
    "optimisation": (
        "learning_rate", "lr_schedule", "lr_final", "lr_warmup_steps", "adam_beta1", "adam_beta2", "adam_eps",
    ),
    "evaluation and saving": (TrainConfig,),
    "machine": ("cache_limit", "cache_dir", "mixed_precision", "machine"),
}  # fmt: skip
"""Titles in their order, and what each group holds: settings by name, or all others of a class. The data format's
settings come last."""
DECIDED = "(default: decided by the data)"


def grouped_flags(method: str, config: TrainConfig, data_format: str, parser: DataParser) -> ConstructorRegistry:
    """Return rules by which tyro shows the flags of a method and of a data format in groups.

    Args:
        method: the method's name.
        config: its settings.
        data_format: the data format's name.
        parser: the data format with its settings.
    """
    rules: dict[type, StructConstructorSpec] = {}
    _divide(rules, config, [(method if title == OWN else title, names) for title, names in _grouped(type(config))])
    of_format = [field.name for field in dataclasses.fields(parser)]  # type: ignore[arg-type]
    _divide(rules, parser, [(f"{data_format} data", of_format)])
    registry = ConstructorRegistry()
    registry.struct_rule(lambda info: rules.get(info.type))
    return registry


def _grouped(kind: type[TrainConfig]) -> Iterator[tuple[str, list[str]]]:
    """The titles and settings of each group. A setting is of the first class that has it, whoever changes it later."""
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
    """Add rules by which tyro takes a dataclass for a struct of groups, each a struct of some of its fields."""
    whole: Any = ConstructorRegistry.get_struct_spec(StructTypeInfo.make(type(settings), settings, False))
    flags = {field.name: _flag(field) for field in whole.fields}
    boxes = []
    for index, (title, names) in enumerate(groups):
        group = type("Group", (), {})
        rules[group] = StructConstructorSpec(dict, tuple(flags[name] for name in names))
        annotated: Any = Annotated[group, tyro.conf.arg(name=title, help="")]
        boxes.append(StructFieldSpec(f"{index}", annotated, MISSING_NONPROP))

    def join(**parts: dict[str, Any]) -> Any:
        return whole.instantiate(**{name: value for part in parts.values() for name, value in part.items()})

    rules[type(settings)] = StructConstructorSpec(join, tuple(boxes))


def _flag(field: StructFieldSpec) -> StructFieldSpec:
    """A field whose flag is its bare name, and whose default, where the data decide it, is not shown as None."""
    is_open = field.default is None and LEFT_TO_DATA in getattr(field.type, "__metadata__", ())
    shown: Any = Annotated[
        field.type, tyro.conf.arg(prefix_name=False, help_behavior_hint=DECIDED if is_open else None)
    ]
    return dataclasses.replace(field, type=shown, helptext=partial(_unwrapped, field.helptext))


def _unwrapped(text: str | Callable[[], str | None] | None) -> str | None:
    """A help text, read from the source only when it is shown, without the line breaks of the source."""
    text = text() if callable(text) else text
    return text and re.sub(r"(?<!\n)\n(?=\w)", " ", text)
