"""The two kinds of web pages: of Gaussians, and of an octree; and pictures of their content."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerfloom.base.counts import counted
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.export.octree_page import make_octree_page
from nerfloom.export.run_gaussians import finite
from nerfloom.export.web import PageFacts, gaussians_of, make_page
from nerfloom.geometry.lenses import LENSES
from nerfloom.geometry.regions import Region, inside_all
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.octree import Octree
from nerfloom.splats.drawing import DRAWN, draw_colors, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.transform import transformed
from nerfloom.training.loaded import Loaded

BEYOND_THE_BOX = "a page traces octrees of one box, and this scene extends beyond it: give --kind gaussians"
"""Refusal of an octree of several boxes."""


@dataclass(frozen=True)
class ScenePage:
    """A page, and its content as Nerfloom draws it."""

    text: str
    """Content of the page."""
    words: str
    """Description of its content."""
    costs: list[str]
    """Sentences about parts removed to fit its size."""
    draw: Callable[[Cameras], Tensor]
    """Function from one camera in the scene's frame, on the model's device, to the colours (H, W, 3) that it sees."""
    lenses: Container[str]
    """Camera models that `draw` takes."""
    chunks: frozenset[str] = frozenset()
    """Names without suffix of the files beside the page that it loads."""


def gaussian_page(
    loaded: Loaded, gaussians: Gaussians, look: Look, facts: PageFacts, turn: Tensor, most: float,
    regions: Sequence[Region],
) -> ScenePage:  # fmt: skip
    """Return the page of Gaussians.

    Args:
        loaded: the run or file.
        gaussians: Gaussians in the scene's frame. All that are not finite are left out and counted.
        look: how they are drawn.
        facts: further data of the page.
        turn: (3, 3) rotation from the scene's frame to the page's.
        most: maximum size of the page, in millions of bytes.
        regions: the page shows their intersection, in the frame of exports.

    Raises:
        ConfigError: if there is nothing to show, or nothing fits.
    """
    model, still = loaded.model, torch.zeros(3)
    good = finite(gaussians, "there are no Gaussians to show; train the run again")
    good = good[inside_all(loaded.placement.original_points(good.means), regions)]
    text, costs = make_page(transformed(good, turn, 1.0, still), replace(facts, look=look), most)
    found = gaussians_of(text)
    back = transformed(found, turn.T, 1.0, still).map(lambda values: values.to(model.device))

    def draw(camera: Cameras) -> Tensor:
        return draw_colors(back, splat_camera(camera, facts.near, look), 1, model.background)

    return ScenePage(text, f"{counted(len(found), 'Gaussians')} of degree {found.degree}", costs, draw, DRAWN)


def octree_page(
    loaded: Loaded, octree: Octree, cameras: Cameras, facts: PageFacts, turn: Tensor, most: float,
    regions: Sequence[Region],
) -> ScenePage:  # fmt: skip
    """Return the page of an octree.

    Args:
        loaded: the run or file.
        octree: its octree, or one that was baked from it, on the CPU.
        cameras: M pinhole cameras in the scene's frame; matter that they see is kept.
        facts, turn, most, regions: as in `gaussian_page`.

    Raises:
        ConfigError: if there is nothing to show, or nothing fits.
    """
    model = loaded.model
    if not octree.layout.num_leaves:
        raise ConfigError("the octree has no leaves to show; bake it again")
    if octree.layout.coarser is not None:
        raise ConfigError(BEYOND_THE_BOX)
    inside = inside_all(loaded.placement.original_points(octree.layout.centers()), regions)
    kept = octree if bool(inside.all()) else octree.part(inside.nonzero()[:, 0])
    text, found, costs = make_octree_page(kept, turn, cameras.to("cpu"), facts, most)
    shown = DrawnOctree(found.to(model.device), replace(found.scene, near=facts.near).to(model.device))
    words = f"{found.layout.num_leaves:,} leaves with harmonics of degree {found.degree}"
    return ScenePage(text, words, costs, lambda camera: shown.render_rgb(View(camera), model.background), LENSES)
