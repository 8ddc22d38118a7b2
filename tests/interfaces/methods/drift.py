"""Drift: Gaussians that each move at a velocity of their own, which they learn."""

from __future__ import annotations

from dataclasses import replace

from nerfloom import LearnsMotion, Optimised
from nerfloom.methods import gaussian_splatting
from nerfloom.methods.gaussian_splatting import GaussianSplatting
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.table import Column

FASTER = 20.0
"""Learning rate of velocities, relative to the rate of centres: a Gaussian may cross the scene."""
REST = 0.5
"""Time when Gaussians are where their columns say."""


class Drift(GaussianSplatting, LearnsMotion):
    """3D Gaussian Splatting with velocities, in scene units for the time from 0 to 1."""

    def declared_columns(self) -> dict[str, Column]:
        if not self.scene.moving:
            return super().declared_columns()
        optimised = Optimised("velocities", FASTER * self.position_rate, sparse=True)
        return {**super().declared_columns(), "velocities": Column((3,), optimised, in_extents=True)}

    def at_time(self, gaussians: Gaussians, time: float | None) -> Gaussians:
        if time is None:  # of a scene that does not move
            return gaussians
        return replace(gaussians, means=gaussians.means + (time - REST) * gaussians.extras["velocities"])


METHOD = replace(gaussian_splatting.METHOD, model=Drift, paper="none")
