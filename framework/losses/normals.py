"""Terms of methods that predict normals: Ref-NeRF (Verbin et al. 2022), equations 10 and 11."""

from __future__ import annotations

from torch import Tensor

from nerfloom.losses.term import LossTerm, RenderedBatch

COARSE_SHARE = 0.1
"""Weight of a coarse level's penalty, relative to the fine one's."""


class NormalPenalty(LossTerm):
    """Mean over rays of a penalty of `normal_penalties`, "normals" or "orientation", from the renderer's extras."""

    def __call__(self, shown: RenderedBatch) -> Tensor | None:
        rendered, key = shown.rendered, f"{self.name}_penalty"
        if not len(rendered.rgb):
            return None
        fine, coarse = rendered.extras[key].mean(), rendered.coarse
        return fine if coarse is None else fine + COARSE_SHARE * coarse.extras[key].mean()
