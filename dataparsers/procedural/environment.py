"""Light from far away in closed form, as sharp or as blurred as a surface reflects it.

It is a sky that brightens upwards, and lamps: functions exp(kappa (cos - 1)) of the angle from a direction, the von
Mises-Fisher distribution without its normalisation. A lamp blurred by a distribution of concentration k is very nearly
another lamp, of concentration kappa k / (kappa + k) and the same total light; here this is the definition.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

NUM_LAMPS = 40
"""Number of lamps."""
SHARPEST, WIDEST = 1500.0, 6.0
"""Largest and smallest concentration of lamps: 1.5 and 24 degrees wide."""


class Environment(NamedTuple):
    """Light from all directions.

    Args:
        directions: (3, L) unit directions of the lamps.
        concentrations: (L,) their concentrations.
        colors: (3, L) light in their middles.
        horizon: (3,) light of the sky at the horizon.
        slope: (3,) increase of the sky's light with the height of a unit direction.
    """

    directions: Tensor
    concentrations: Tensor
    colors: Tensor
    horizon: Tensor
    slope: Tensor

    def light(self, directions: Tensor, roughness: Tensor) -> Tensor:
        """Return the mean light (3, R) around directions.

        Args:
            directions: (3, R) unit directions.
            roughness: (R,) inverse concentrations of the distributions around them; 0 for the directions alone.
        """
        kappa = self.concentrations.to(directions)[:, None]
        blurred = kappa / (1 + kappa * roughness)
        kept = _total(kappa) / _total(blurred)
        cosines = self.directions.to(directions).T @ directions
        lamps = self.colors.to(directions) @ (kept * torch.exp(blurred * (cosines - 1)))
        height = directions[2] * torch.exp(-roughness)  # a harmonic of degree 1: Ref-NeRF, equation 8
        return self.horizon.to(directions)[:, None] + self.slope.to(directions)[:, None] * height + lamps


def _total(kappa: Tensor) -> Tensor:
    """Return the light of lamps of concentration `kappa` over all directions, divided by 2 pi."""
    return -torch.expm1(-2 * kappa) / kappa


def make_environment(seed: int) -> Environment:
    """Return an environment of lamps with random directions, widths and colours of a `seed`."""
    random = np.random.default_rng(seed)
    height = random.uniform(-0.9, 1.0, NUM_LAMPS)
    azimuth = random.uniform(0, 2 * math.pi, NUM_LAMPS)
    radius = np.sqrt(1 - height**2)
    sharpness = np.exp(random.uniform(math.log(WIDEST), math.log(SHARPEST), NUM_LAMPS))
    hues = random.dirichlet((1.5, 1.5, 1.5), NUM_LAMPS).T
    strength = random.uniform(0.3, 1.0, NUM_LAMPS) * (sharpness / WIDEST) ** 0.15
    return Environment(
        torch.from_numpy(np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height])),
        torch.from_numpy(sharpness),
        torch.from_numpy(1.5 * hues * strength),
        torch.tensor([0.16, 0.17, 0.19], dtype=torch.float64),
        torch.tensor([0.06, 0.09, 0.14], dtype=torch.float64),
    )
