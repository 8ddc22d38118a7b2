"""The list of all checks of a method, and the functions that run them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from nerfloom.base.config import TrainConfig
from nerfloom.method import Method
from nerfloom.ray_model import RayModel
from nerfloom.testing import declaration, learning, rendering, storage
from nerfloom.testing.finding import Finding
from nerfloom.testing.method_under_test import MethodUnderTest


@dataclass(frozen=True)
class Check:
    """A requirement of every method."""

    name: str
    """Name of the check in findings."""
    run: Callable[[MethodUnderTest], str]
    """Function that returns a line for people; it raises Fault, or any error of the method, if the check fails."""
    needs: tuple[str, ...] = ()
    """Names of checks that must pass before this one, if they are run."""
    rays_only: bool = False
    """Whether the check applies only to models that are a `RayModel`."""


CHECKS = (
    Check("config", declaration.check_config),
    Check("summary", declaration.check_summary),
    Check("build", rendering.check_build, ("config",)),
    Check("render", rendering.check_render, ("build",), rays_only=True),
    Check("view", rendering.check_view, ("build", "render")),
    Check("few rays", rendering.check_few_rays, ("render",), rays_only=True),
    Check("background", rendering.check_background, ("render", "view")),
    Check("loss", learning.check_loss, ("render", "view")),
    Check("groups", learning.check_groups, ("build",)),
    Check("gradients", learning.check_gradients, ("loss", "groups")),
    Check("unused parameters", learning.check_unused, ("gradients",)),
    Check("repetition", learning.check_repetition, ("gradients",)),
    Check("nan colours", learning.check_nan_colors, ("loss",)),
    Check("bfloat16", learning.check_bfloat16, ("gradients",)),
    Check("training", learning.check_training, ("gradients",)),
    Check("learning", learning.check_learning, ("training", "background")),
    Check("evaluation", rendering.check_evaluation, ("training",)),
    Check("chunks", rendering.check_chunks, ("evaluation",), rays_only=True),
    Check("nan rays", rendering.check_nan_rays, ("chunks",), rays_only=True),
    Check("checkpoint", storage.check_checkpoint, ("training",)),
)
"""All checks, in the order of running."""


def check_method(method: Method, name: str = "the method", config: TrainConfig | None = None) -> list[Finding]:
    """Check that a method meets the requirements of the trainer and the evaluator, on small scenes made in memory.

    On the CPU it takes seconds for small models, so give a config with few layers, levels or cells.

    Args:
        name: the method's name in messages.
        config: settings for the check; the method's defaults if None.

    Returns:
        A finding for each of `CHECKS` that was run. Checks that depend on a failed check are omitted. An error raised
        by the method becomes a finding.
    """
    subject, findings = MethodUnderTest(method, name, config), dict[str, Finding]()
    casts_rays = isinstance(method.model, type) and issubclass(method.model, RayModel)
    checks = [check for check in CHECKS if casts_rays or not check.rays_only]
    names = {check.name for check in checks}
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        for check in checks:
            if all(need in findings and findings[need].ok for need in check.needs if need in names):
                findings[check.name] = _finding(check, subject)
    return list(findings.values())


def _finding(check: Check, subject: MethodUnderTest) -> Finding:
    try:
        return Finding(check.name, True, check.run(subject))
    except Exception as error:
        return Finding(check.name, False, subject.described(error))


def assert_method(method: Method, name: str = "the method", config: TrainConfig | None = None) -> None:
    """Check a method, called `name` in messages, with `config` or its defaults, in a test.

    Raises:
        AssertionError: if a check fails; the message has a line for each failed check.
    """
    failed = [finding for finding in check_method(method, name, config) if not finding.ok]
    if failed:
        raise AssertionError("\n".join([f"{name} fails {len(failed)} checks:", *(f.line() for f in failed)]))
