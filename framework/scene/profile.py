"""What a scene needs and what it can do without: facts read from its data, and the decisions that follow."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from framework.base.decisions import Decision
from framework.data.dataset import Dataset
from framework.data.light import light_spread


@dataclass(frozen=True)
class SceneProfile:
    """Facts about the photographs, and what was decided by them."""

    images: int
    """Photographs to learn from."""
    width: int
    """Of the largest photograph, pixels."""
    height: int
    moving: bool
    """The photographs have times."""
    transparent: float | None
    """Share of pixels that are fully transparent; None where no photograph has alpha."""
    ignored: float | None
    """Share of pixels that are not learnt from: masks ignore them, or no ray leads there; None for none."""
    light: float | None
    """By how many stops light differs between the photographs (`appearance.light_spread`); None with alpha."""
    camera: str
    """The cameras' model."""
    decisions: tuple[Decision, ...]

    @classmethod
    def of(cls, dataset: Dataset, decisions: list[Decision]) -> SceneProfile:
        """Look at the data."""
        cameras, alpha = dataset.cameras, dataset.scene.has_alpha
        kept, total = dataset.kept, int(dataset.cameras.offsets[-1])
        transparent = sum(int((dataset.image(index)[..., 3] == 0).sum()) for index in range(len(dataset) * alpha))
        return cls(
            images=len(dataset),
            width=int(cameras.widths.max()),
            height=int(cameras.heights.max()),
            moving=dataset.scene.moving,
            transparent=transparent / total if alpha else None,
            ignored=None if kept is None else 1 - len(kept) / total,
            light=None if dataset.light is None else light_spread(dataset.light),
            camera=cameras.model,
            decisions=tuple(decisions),
        )

    def lines(self) -> list[str]:
        """For people."""
        alpha = "no alpha" if self.transparent is None else f"alpha ({self.transparent:.0%} of pixels transparent)"
        motion = "moving" if self.moving else "still"
        facts = f"scene: {self.images} images of {self.width} x {self.height}, {self.camera} camera, {alpha}, {motion}"
        if self.ignored is not None:
            facts += f", {self.ignored:.0%} of pixels ignored (masks, or no ray)"
        if self.light is not None:
            facts += f", light differs by {self.light:.2f} stops"
        return [facts, *(decision.line() for decision in self.decisions)]

    def as_plain(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)
