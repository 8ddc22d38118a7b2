"""Settings as nerfbaselines gives and shows them: flat names with dots, and text where a command line gave them."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from torch import Tensor

from framework.base.config import TrainConfig

WORDS = {"true": True, "false": False, "none": None, "null": None}


def parse_overrides(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides as nested plain values: dots nest, and text, which is all that a command line gives, is read."""
    nested: dict[str, Any] = {}
    for key, value in overrides.items():
        *groups, name = key.split(".")
        place = nested
        for group in groups:
            place = place.setdefault(group, {})
        place[name] = _read(value) if isinstance(value, str) else value
    return nested


def _read(text: str) -> Any:
    """A Python literal, true, false, none or null in any case; other text as it is."""
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return text


def flattened(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings with dots in their names."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= flattened(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def over_any(config: TrainConfig, background: Tensor) -> TrainConfig:
    """The settings, with training over random colours if it would be over one that pictures are not made over."""
    fixed = {"white": 1.0, "black": 0.0}.get(config.background)
    if fixed is None or bool((background == fixed).all()):
        return config
    return replace(config, background="random")
