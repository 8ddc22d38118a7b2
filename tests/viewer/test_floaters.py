"""Floaters of the viewer: Gaussians that an edit would remove, and matter in front of points that are known."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.data.tracks import Sightings
from nerfloom.geometry.rays import Rays
from nerfloom.renderable import RendersRays
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.viewer.floaters import can_find, find_floaters
from tests.edit.clouds import ball_in_capture
from tests.web.helpers import some_cameras

POINTS = torch.tensor([[0.1, 0.0, 0.05], [0.4, 0.3, 0.0], [-0.3, 0.2, 0.2], [0.0, -0.4, -0.1], [0.2, -0.1, 0.4]])


class Fogged(RendersRays):
    """A scene with a surface far behind everything, and with fog at distance 1 from one of its cameras."""

    scene = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 20.0, 4, False, False, 200)
    device = torch.device("cpu")
    rays_at_once = 3

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        assert rays.camera_indices is not None
        depth = torch.where(rays.camera_indices == 2, 1.0, 10.0)
        one = torch.ones_like(depth)
        return Rendered(one[:, None].expand(-1, 3), depth, depth, one, 0)

    def render_view(self, view: View, background: Tensor) -> Picture:
        raise NotImplementedError


def fogged(**changes: Any) -> Any:
    """The scene with a reconstruction: each camera sees each point."""
    count, cameras = len(POINTS), some_cameras()
    images = torch.arange(len(cameras)).repeat_interleave(count)
    sightings = Sightings(images, POINTS.repeat(len(cameras), 1), torch.full((count * len(cameras),), 1e-3))
    parsed = SimpleNamespace(sightings=sightings, cameras=cameras, downscale_factor=1, times=None)
    found = SimpleNamespace(**{**vars(parsed), **changes})
    return SimpleNamespace(model=Fogged(), source=object(), origin=Path("run"), parsed=lambda split: found)


def test_gaussians_that_an_edit_would_remove(tmp_path: Path) -> None:
    ball = ball_in_capture(tmp_path)
    assert ball.loaded is not None
    assert can_find(ball.loaded)
    found = find_floaters(ball.loaded, None)
    torch.testing.assert_close(found.positions, ball.in_scene().means[-1:], atol=1e-5, rtol=0)
    assert found.words.startswith(f"1 of {len(ball)} Gaussians float")
    assert not can_find(replace(ball.loaded, source=None))


def test_matter_in_front_of_known_points_is_where_rays_meet_it() -> None:
    found, eye = find_floaters(fogged(), None), some_cameras().camera_to_worlds[2, :, 3]
    assert found.words.startswith("5 of 20 sightings")
    towards = torch.nn.functional.normalize(POINTS - eye, dim=-1)
    away = (found.positions - eye)[:, None] - towards
    assert float(away.norm(dim=-1).amin(1).max()) < 0.75 / 200  # half the diagonal of a pixel at distance 1
    assert len(away.norm(dim=-1).argmin(1).unique()) == 5


def test_points_without_known_distances_are_named() -> None:
    with pytest.raises(ConfigError, match="no points with known distances"):
        find_floaters(fogged(sightings=None), None)
