"""A faster file is drawn while the camera moves, and the run when it rests."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.cli.viewer import main
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.octree import Octree
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import Pose, Request
from tests.conftest import Refused
from tests.octrees.balls import ball


def opened(octree: Octree) -> Loaded:
    file = Path("ball.octree")
    return Loaded(DrawnOctree(octree, octree.scene), octree.placement, "octree", file, file)


def at(x: float, output: str = "rgb") -> Request:
    """A view from (x, 0, 3), down."""
    return Request(Pose((1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0), 0.6), 60, 40, output)


def rendered(octree: Octree, request: Request) -> np.ndarray:
    model = DrawnOctree(octree, octree.scene)
    return model.render_view(View(request.camera()), model.background).rgb.numpy()


def first_of(queue: RenderQueue, pictures: list[np.ndarray], request: Request) -> np.ndarray:
    """The first picture of a request, when all are drawn."""
    before = len(pictures)
    queue.ask(1, lambda _: request)
    while queue.draw_next() is not None or queue._browsers[1].pieces:
        time.sleep(0.02)
    return pictures[before]


@pytest.mark.parametrize("output", ["rgb", "error"])
def test_the_file_moves_and_the_run_rests(output: str) -> None:
    """The file's scene is twice as large. Without photographs, the output `error` is the run's colours."""
    octree = ball()
    bright = replace(octree.leaves, offsets=octree.leaves.offsets + 0.7)
    other = replace(octree, leaves=bright)
    layout = replace(octree.layout, origin=2 * octree.layout.origin, cell=2 * octree.layout.cell)
    large = replace(other, layout=layout, placement=Placement.of(torch.eye(3, 4), 0.5), far=20.0)
    pictures, queue = list[np.ndarray](), RenderQueue(opened(octree), quick=opened(large))
    queue.add(1, Browser(lambda image, quality: pictures.append(image.copy())))
    firsts = []
    for request in (at(0.0, output), at(0.2, output)):
        firsts.append(first_of(queue, pictures, request))
        np.testing.assert_allclose(pictures[-1] / 255, rendered(octree, request), atol=0.01)
    assert float(np.abs(rendered(octree, at(0.2)) - rendered(other, at(0.2))).max()) > 0.1
    moving = other if output == "rgb" else octree
    np.testing.assert_allclose(firsts[0] / 255, rendered(octree, at(0.0)), atol=0.01)  # it measures the run's speed
    np.testing.assert_allclose(firsts[1] / 255, rendered(moving, at(0.2)), atol=0.01)


def test_two_runs_side_by_side_have_no_faster_file(refused: Refused) -> None:
    assert "leave one out" in refused(main, "one.ply", "other.ply", "--while-moving", "quick.octree", status=2)
