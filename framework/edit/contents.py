"""The contents of a scene: merged files, the number of Gaussians, and the degree of their harmonics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.scale import read_scale
from nerfloom.data.offsets import read_offset
from nerfloom.edit.edited import Edited
from nerfloom.edit.refit import refitted
from nerfloom.edit.sightings import sightings, training_views
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussian_limit import visibility, with_degree
from nerfloom.splats.gaussians import Gaussians


def merge(edited: Edited, files: tuple[Path, ...]) -> Edited:
    """Add the Gaussians of files, which are in the same frame and unit.

    Args:
        files: files of Gaussians.

    Raises:
        ConfigError: if a file is in another unit.
        DataError: if a file cannot be read.
    """
    parts = [replace(edited.gaussians, extras={})]
    for file in files:
        found, look = read_gaussians(file)
        unit = read_scale(file).unit
        if unit and edited.scale.unit and unit != edited.scale.unit:
            raise ConfigError(f"merge: {file} is in {unit}, and the others in {edited.scale.unit}: scale it first")
        if unit != edited.scale.unit:
            known = f"{file} is in {unit}, and the unit of the others" if unit else f"the unit of {file}"
            say(f"warning: {known} is not known: lengths are taken as they are")
        if look != edited.look:
            say(f"warning: {file} was drawn otherwise ({look.words()}), and is drawn as the others from now on")
        parts.append(replace(found, means=found.means.double() + read_offset(file)))
    degree = max(part.degree for part in parts)
    return replace(edited, gaussians=Gaussians.joined([_padded(part, degree) for part in parts]))


def reduce_to(edited: Edited, count: int, refit_steps: int = 0) -> Edited:
    """Keep the Gaussians that contribute most.

    A contribution is the sum of blending weights over all pixels of the training images. Without photographs it is
    opacity times area.

    Args:
        count: maximum number of Gaussians.
        refit_steps: number of training steps that make the kept Gaussians look like all of them, from the cameras of
            the training images; 0 for none. If all are kept, none are refitted.

    Raises:
        ConfigError: if Gaussians cannot be drawn for the cameras of the photographs, or refitting lacks photographs.
    """
    if refit_steps:
        edited.photographed("refit_steps")
    if count >= len(edited):
        if refit_steps:
            say(f"reduce_to: all {len(edited):,} Gaussians are kept, so nothing is refitted")
        return edited
    if edited.has_photographs:
        loaded = edited.photographed("reduce_to")
        values = sightings(edited.in_scene(), training_views(loaded, edited.look)).weights.cpu()
        say(f"reduce_to: the {count:,} kept have {_share(values, count):.2%} of the weight in training images")
    else:
        values = visibility(edited.gaussians).double()
        say("reduce_to: without photographs, Gaussians count by opacity times area")
    kept = edited.kept(values.argsort(descending=True, stable=True)[:count].sort().values)
    return refitted(kept, edited, refit_steps) if refit_steps else kept


def set_degree(edited: Edited, degree: int) -> Edited:
    """Remove the harmonics above `degree`, 0 to 3."""
    return replace(edited, gaussians=with_degree(edited.gaussians, degree))


def _share(values: torch.Tensor, count: int) -> float:
    """Return the share of the sum that the largest values have."""
    return float(values.sort(descending=True).values[:count].sum() / values.sum().clamp(min=1e-300))


def _padded(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return Gaussians with harmonics up to a degree; missing ones are 0."""
    missing = DEGREES[degree] - gaussians.harmonics.shape[2]
    return replace(gaussians, harmonics=torch.nn.functional.pad(gaussians.harmonics, (0, missing)))
