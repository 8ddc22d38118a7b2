"""Recipes: lists of steps with their settings, as YAML, which give the same result each time.

    steps:
      - crop_box: {low: [-1, -1, -0.2], high: [1, 1, 2]}
      - drop_floaters:
      - set_up: {up: [0, -1, 0]}

A step is a function of `nerfloom.edit`, and its settings are the function's arguments after the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from nerfloom.base.arguments import arguments_of
from nerfloom.base.atomic import write_atomically
from nerfloom.base.config import Range
from nerfloom.base.errors import ConfigError, nearest, shown
from nerfloom.base.plain import read_yaml, to_plain
from nerfloom.edit.contents import merge, reduce_to, set_degree
from nerfloom.edit.crop import crop_box, crop_mask, crop_polygon, crop_region, crop_sphere
from nerfloom.edit.drop import drop_faint, drop_floaters, drop_isolated, drop_large, drop_needles
from nerfloom.edit.edited import Edited
from nerfloom.edit.place import align_floor, align_points, move, rotate, scale, set_up

FUNCTIONS: tuple[Callable[..., Edited], ...] = (
    crop_box, crop_sphere, crop_region, crop_polygon, crop_mask,
    drop_faint, drop_large, drop_needles, drop_isolated, drop_floaters,
    move, rotate, scale, set_up, align_points, align_floor,
    merge, reduce_to, set_degree,
)  # fmt: skip
"""All steps."""
STEPS = {step.__name__: step for step in FUNCTIONS}
"""Steps by name."""
TINY = 1e-12
"""Smallest length or factor that is positive."""
RANGES: dict[str, Range] = {
    "min_opacity": (0, 1),
    "max_opacity": (0, 1),
    "share": (0, 1),
    "min_views": (1, math.inf),
    "max_size": (TINY, math.inf),
    "max_ratio": (1, math.inf),
    "neighbours": (1, 100),
    "radius": (TINY, math.inf),
    "factor": (TINY, 1 / TINY),
    "max_tilt": (0, 90),
    "tolerance": (TINY, math.inf),
    "seed": (0, 2**63 - 1),
    "count": (1, math.inf),
    "refit_steps": (0, math.inf),
    "degree": (0, 3),
}
"""Allowed ranges of settings, in all steps."""


@dataclass(frozen=True)
class Step:
    """A step of a recipe."""

    name: str
    """Name of the function, one of `STEPS`."""
    settings: Mapping[str, Any]
    """Arguments of the function after the first."""

    def __call__(self, edited: Edited) -> Edited:
        """Take the step from the Gaussians `edited`.

        Raises:
            ConfigError: if the settings do not fit the Gaussians.
            DataError: if a file cannot be read.
        """
        return STEPS[self.name](edited, **self.settings)

    def files(self) -> Iterator[Path]:
        """Yield the files that the step reads."""
        for value in self.settings.values():
            yield from (each for each in (value if isinstance(value, tuple) else (value,)) if isinstance(each, Path))


def step_of(name: Any, values: Any, where: str) -> Step:
    """Return a step with settings of the right types and in their ranges.

    Args:
        name: name of the step.
        values: plain values of its settings by name; None for no settings.
        where: name of the source in error messages.

    Raises:
        ConfigError: if there is no such step, or a setting is unknown, missing or cannot be used.
    """
    if name not in STEPS:
        raise ConfigError(f"{where}: there is no step {shown(name)}. {nearest(shown(name), STEPS)}")
    settings = arguments_of(STEPS[name], values, where, given=1)
    for key in settings.keys() & RANGES.keys():
        low, high = RANGES[key]
        if settings[key] is not None and not low <= settings[key] <= high:
            allowed = f"at least {low:g}" if high == math.inf else f"from {low:g} to {high:g}"
            raise ConfigError(f"{where}: '{key}' is {shown(settings[key])}; it must be {allowed}")
    return Step(name, settings)


def read_recipe(file: Path) -> list[Step]:
    """Read a recipe.

    Args:
        file: the YAML file. Files that its steps name are looked for from the working folder.

    Raises:
        ConfigError: if the file cannot be read, holds no recipe, or a step cannot be taken.
    """
    content = read_yaml(file)
    steps = content.get("steps")
    if content.keys() != {"steps"} or not isinstance(steps, list):
        raise ConfigError(f"{file} must hold 'steps' alone, a list such as '- drop_faint: {{min_opacity: 0.05}}'")
    found = []
    for number, step in enumerate(steps, 1):
        where = f"{file}: step {number}"
        if isinstance(step, str):  # a name alone
            step = {step: None}
        if not isinstance(step, dict) or len(step) != 1:
            raise ConfigError(f"{where} is {shown(step)}; it must be one name with settings, such as '- move: {{...}}'")
        ((name, values),) = step.items()
        found.append(step_of(name, values, f"{where} ({name})" if isinstance(name, str) else where))
    return found


def write_recipe(file: Path, steps: Sequence[Step]) -> None:
    """Write `steps` to a YAML `file` that `read_recipe` reads as the same steps.

    Raises:
        OSError: if the file cannot be written.
    """
    rows = [{step.name: {name: to_plain(value) for name, value in step.settings.items()}} for step in steps]
    text = yaml.safe_dump({"steps": rows}, sort_keys=False)
    write_atomically(file, lambda stream: stream.write(text.encode()))
