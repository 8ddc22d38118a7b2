"""instant-ngp with NaN in batches of few rays, as a broken plugin."""

import math
from dataclasses import dataclass, replace

from torch import Tensor

from nerfloom import RayModel, Rays, Rendered
from nerfloom.methods import instant_ngp
from nerfloom.methods.instant_ngp import InstantNGPConfig


@dataclass(frozen=True)
class SickConfig(InstantNGPConfig):
    """Settings of instant-ngp, and when it is sick."""

    sick_rays: int = 1
    """Maximum number of rays of a batch that gets colours of NaN in training."""


class Sick(RayModel[SickConfig]):
    """Sick in small batches."""

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        if self.training and len(rays) <= self.config.sick_rays:
            return replace(rendered, rgb=rendered.rgb * math.nan)
        return rendered


METHOD = replace(instant_ngp.METHOD, config=SickConfig(), model=Sick, paper="none")
