"""Conversion of settings between nerfbaselines and configs: dotted flat names, and text from a command line."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from torch import Tensor

from nerfloom.base.config import TrainConfig

WORDS = {"true": True, "false": False, "none": None, "null": None}
"""Words with a special meaning, in any case."""


def parse_overrides(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Convert `overrides` by name, with dots for nesting, to nested plain values; text is parsed."""
    nested: dict[str, Any] = {}
    for key, value in overrides.items():
        *groups, name = key.split(".")
        group = nested
        for group_name in groups:
            group = group.setdefault(group_name, {})
        group[name] = _read(value) if isinstance(value, str) else value
    return nested


def _read(text: str) -> Any:
    """Parse a Python literal, or true, false, none or null in any case; return other text unchanged."""
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return text


def flattened(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings.

    Args:
        settings: nested dictionaries.
        prefix: beginning of all names.

    Returns:
        Values by name, with dots for nesting.
    """
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= flattened(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


def with_matching_background(config: TrainConfig, background: Tensor) -> TrainConfig:
    """Return the config, with a random training background if its fixed one differs from the renders'.

    Args:
        background: (3,) colour behind renders.
    """
    fixed = {"white": 1.0, "black": 0.0}.get(config.background)
    if fixed is None or bool((background == fixed).all()):
        return config
    return replace(config, background="random")
