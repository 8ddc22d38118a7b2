"""The profile of a scene: properties of its data, and decisions based on them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from nerfloom.base.counts import counted
from nerfloom.base.decisions import Decision
from nerfloom.data.dataset import Dataset
from nerfloom.data.light_spread import light_spread


@dataclass(frozen=True)
class SceneProfile:
    """Properties of the images, and decisions based on them."""

    images: int
    """Number of training images."""
    width: int
    """Width of the largest image, pixels."""
    height: int
    """Height of the largest image, pixels."""
    moving: bool
    """Whether the images have times."""
    transparent: float | None
    """Fraction of fully transparent pixels; None if no image has alpha."""
    ignored: float | None
    """Fraction of pixels that are masked out or have no ray; None if there are none."""
    light: float | None
    """Spread of the light between images, in stops (`light_spread.light_spread`); None with alpha."""
    camera: str
    """Model of the cameras."""
    decisions: tuple[Decision, ...]
    """Decisions on open settings."""
    scenes: int = 1
    """Number of scenes in the images."""

    @classmethod
    def of(cls, dataset: Dataset, decisions: list[Decision]) -> SceneProfile:
        """Compute the profile of the training images `dataset`, with `decisions` to list."""
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
            light=None if dataset.light is None else light_spread(dataset.light, cameras.camera_to_worlds),
            camera=cameras.model,
            decisions=tuple(decisions),
            scenes=dataset.scene.num_scenes,
        )

    def lines(self) -> list[str]:
        """Return the profile as lines of text."""
        alpha = "no alpha" if self.transparent is None else f"alpha ({self.transparent:.0%} of pixels transparent)"
        motion = "moving" if self.moving else "still"
        images = f"{counted(self.images, 'images')} of {self.width} x {self.height}"
        facts = f"scene: {images}, {self.camera} camera, {alpha}, {motion}"
        if self.scenes > 1:
            facts += f", {self.scenes} scenes"
        if self.ignored is not None:
            facts += f", {self.ignored:.0%} of pixels ignored (masks, or no ray)"
        if self.light is not None:
            facts += f", light differs by {self.light:.2f} stops"
        return [facts, *(decision.line() for decision in self.decisions)]

    def as_plain(self) -> dict[str, Any]:
        """Return the profile as a dictionary for JSON."""
        return asdict(self)
