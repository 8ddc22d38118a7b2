"""Checks of a method's settings and summary.

Each check returns a line for people, and raises Fault if it fails.
"""

from __future__ import annotations

import inspect
import sys
from dataclasses import fields

import yaml

from nerfloom.base.config import TrainConfig
from nerfloom.base.plain import from_plain, to_plain
from nerfloom.testing.finding import Fault
from nerfloom.testing.method_under_test import MethodUnderTest


def check_config(subject: MethodUnderTest) -> str:
    """Check that the settings of `subject` are a frozen dataclass derived from TrainConfig, and survive config.yml."""
    config = subject.config
    kind = type(config)
    if not isinstance(config, TrainConfig):
        raise Fault(f"{kind.__name__} must derive from nerfloom.TrainConfig")
    # Python itself refuses a non-frozen dataclass that derives from a frozen one.
    if "__dataclass_fields__" not in vars(kind) and inspect.get_annotations(kind):
        raise Fault(f"{kind.__name__} is not itself a dataclass; write @dataclass(frozen=True) above it")
    decided, _ = subject.method.decided(config, subject.still.scene)
    for label, before in (("the settings", config), ("decided settings", decided)):
        written = yaml.safe_dump(to_plain(before))
        after = from_plain(subject.method.config, yaml.safe_load(written), "config.yml")
        if after != before:
            lost = [f.name for f in fields(before) if getattr(after, f.name) != getattr(before, f.name)]
            raise Fault(
                f"{label} do not survive config.yml ({', '.join(lost) or type(before).__name__}); a setting is a bool, "
                "a number, a string, a Path, a Literal, a tuple of those, or a dataclass of those"
            )
    return f"{len(fields(config))} settings survive config.yml"


def check_summary(subject: MethodUnderTest) -> str:
    """Check that the module of `subject` has a docstring; its first line is the method's summary."""
    module = type(subject.method.config).__module__
    docstring = getattr(sys.modules.get(module), "__doc__", None) or ""
    summary = docstring.strip().split("\n")[0]
    if not summary:
        raise Fault(f"the module {module} has no docstring; ns-train --help shows its first line")
    return summary
