"""Steps that are taken one after another, each with a line on its effect and cost."""

from __future__ import annotations

from collections.abc import Sequence

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.errors import ConfigError
from nerfloom.edit.edited import Edited
from nerfloom.edit.held_out import HeldOut
from nerfloom.edit.recipe import Step


def take_steps(edited: Edited, steps: Sequence[Step], held_out: HeldOut | None = None) -> Edited:
    """Take `steps` from `edited`, and report their effects, and costs by `held_out`, photographs or None.

    Raises:
        ConfigError: if a step cannot be taken, or leaves no Gaussians.
        DataError: if a file of a step cannot be read.
    """
    psnr: float | None = None
    for number, step in enumerate(steps, 1):
        before, edited = edited, step(edited)
        if not len(edited):
            raise ConfigError(
                f"step {number} ({step.name}) leaves none of {len(before):,} Gaussians; change its settings"
            )
        said = f"{number} {step.name}: {_change(before, edited)}"
        if held_out is not None and looks_different(before, edited):
            was = held_out.psnr(before) if psnr is None else psnr
            psnr = held_out.psnr(edited)
            said += f"; PSNR {was:.2f} to {psnr:.2f} dB ({psnr - was:+.2f}) on {len(held_out.views)} held-out images"
        say(said)
    return edited


def looks_different(before: Edited, after: Edited) -> bool:
    """Return whether photographs tell `before` from `after`: not if Gaussians only moved with the cameras."""
    return len(before) != len(after) or before.gaussians.degree != after.gaussians.degree


def _change(before: Edited, after: Edited) -> str:
    """Return a description of a step's effect."""
    count, left = len(before), len(after)
    if left > count:
        return f"adds {left - count:,} to {counted(count, 'Gaussians')}"
    if left < count:
        return f"removes {count - left:,} of {counted(count, 'Gaussians')}"
    if after.gaussians.degree < before.gaussians.degree:
        return f"harmonics up to degree {after.gaussians.degree} of {before.gaussians.degree}"
    if after.placement is not before.placement:
        return f"moves {counted(count, 'Gaussians')}"
    return f"removes none of {counted(count, 'Gaussians')}"
