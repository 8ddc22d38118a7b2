"""All checks of a method, and which of them make sense only where others hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from framework.base.config import TrainConfig
from framework.method import Method
from framework.ray_model import RayModel
from framework.tools.testing import declaration, learning, rendering, storage
from framework.tools.testing.finding import Finding
from framework.tools.testing.subject import Subject


@dataclass(frozen=True)
class Check:
    """One thing that is asked of every method."""

    name: str
    """What findings call it."""
    run: Callable[[Subject], str]
    """Says in a line what it found; raises Fault, or lets through what the method raises, where that is wrong."""
    needs: tuple[str, ...] = ()
    """Checks without which it would only find again what they have found, as far as they are made."""
    rays_only: bool = False
    """It is made of a `RayModel` only."""


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
"""In the order in which they are made."""


def check_method(method: Method, name: str = "the method", config: TrainConfig | None = None) -> list[Finding]:
    """Whether a method keeps what the trainer and the evaluator rely on, on small scenes made in memory.

    It takes seconds on the processor where the model is small; a config with fewer layers, levels or cells makes it so.

    Args:
        method: as its entry point names it.
        name: what messages call it.
        config: settings to check it with; the method's own if None.
    Returns: what each check found. One that needs what another has found broken is left out, so where nothing is
        wrong all of `CHECKS` are there. What the method raises becomes a finding.
    """
    subject, findings = Subject(method, name, config), dict[str, Finding]()
    casts_rays = isinstance(method.model, type) and issubclass(method.model, RayModel)
    made = [check for check in CHECKS if casts_rays or not check.rays_only]
    names = {check.name for check in made}
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        for check in made:
            if all(need in findings and findings[need].ok for need in check.needs if need in names):
                findings[check.name] = _finding(check, subject)
    return list(findings.values())


def _finding(check: Check, subject: Subject) -> Finding:
    try:
        return Finding(check.name, True, check.run(subject))
    except Exception as error:
        return Finding(check.name, False, subject.described(error))


def assert_method(method: Method, name: str = "the method", config: TrainConfig | None = None) -> None:
    """Check a method in a test. Arguments as for `check_method`.

    Raises: AssertionError that lists all that is wrong.
    """
    failed = [finding for finding in check_method(method, name, config) if not finding.ok]
    if failed:
        raise AssertionError("\n".join([f"{name} fails {len(failed)} checks:", *(f.line() for f in failed)]))
