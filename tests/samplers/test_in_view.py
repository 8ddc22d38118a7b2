"""Pixels that an occupancy grid is seen through: no other one shows anything, and pictures stay the same."""

import dataclasses

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.evaluation.paths import look_at
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.ray_model import RayModel
from nerfloom.registry import load_method
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.in_view import pixels_in_view
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.uniform import UniformSampler

BOX = torch.tensor([[-1.0, -0.8, -1.2], [1.0, 0.8, 1.0]])
SIZE = 144, 120


def camera(position: tuple[float, float, float], focal: float = 130.0, model: str = "pinhole") -> Cameras:
    pose = look_at(torch.tensor(position), torch.tensor([0.1, 0.0, -0.1]), torch.tensor([0.0, 0.0, 1.0]))[:3]
    one = torch.ones(1)
    height, width = (torch.tensor([side]) for side in SIZE)
    return Cameras(pose[None], focal * one, 0.9 * focal * one, 55 * one, 80 * one, width, height, model)


def sampler(share: float = 2e-3, slices: int = 1, **options: bool) -> OccupancySampler:
    """A grid with a few occupied cells, those at the corners of the box among them."""
    grid = OccupancySampler(BOX, resolution=16, num_steps=200, slices=slices, moving=slices > 1, **options)
    drawn = torch.rand(grid.occupied.shape, generator=torch.Generator().manual_seed(3)) < share
    drawn.view(slices, -1)[:, [0, -1]] = True
    grid.carve(drawn)
    return grid


def hit(grid: OccupancySampler, view: View) -> Tensor:
    """The pixels with one of sixteen rays through an occupied cell."""
    rays = view.camera.pixel_rays(view.pixels().reshape(-1), 0.0, 20.0, view.times(), subpixels(16))
    found = grid.begin(rays, False, 0.0).wave(1)
    assert found is not None
    return (torch.bincount(found.owners, minlength=len(rays)) > 0).view(view.height, view.width, 16).any(-1)


@pytest.mark.parametrize("position", [(4.0, 1.0, 0.5), (-2.0, 2.5, -3.0), (0.2, 1.6, 0.3)])
@pytest.mark.parametrize("focal", [130.0, 500.0])  # the grid inside the picture, and cut off by its edges
def test_no_other_pixel_meets_an_occupied_cell(position: tuple[float, float, float], focal: float) -> None:
    grid, view = sampler(), View(camera(position, focal))
    seen, met = pixels_in_view(grid, view), hit(grid, view)
    assert seen is not None
    assert not bool((met & ~seen).any())
    print(f"{int(met.sum())} pixels meet a cell, {int(seen.sum())} of {seen.numel()} are taken to")
    assert bool(met.any())
    if position[0] == 4.0 and focal == 130.0:
        assert int(seen.sum()) < 0.5 * seen.numel()


def test_a_camera_among_the_cells_may_see_some_everywhere() -> None:
    seen = pixels_in_view(sampler(share=0.5), View(camera((0.2, 0.1, 0.0))))
    assert seen is not None
    assert bool(seen.all())


def test_each_slice_of_time_has_its_own() -> None:
    grid = sampler(slices=4)
    for time in (0.0, 0.25, 0.6, 1.0):
        view = View(camera((4.0, 1.0, 0.5)), time)
        seen = pixels_in_view(grid, view)
        assert seen is not None
        assert not bool((hit(grid, view) & ~seen).any())
        assert int(seen.sum()) < 0.6 * seen.numel()


def test_where_it_is_not_known_nothing_is_said() -> None:
    view, grid = View(camera((4.0, 1.0, 0.5))), sampler()
    assert pixels_in_view(grid, view) is not None
    assert pixels_in_view(UniformSampler(8), view) is None
    assert pixels_in_view(sampler(endless=True), view) is None
    assert pixels_in_view(OccupancySampler(BOX, resolution=16, levels=2), view) is None
    assert pixels_in_view(grid, View(camera((4.0, 1.0, 0.5), model="fisheye"))) is None
    assert pixels_in_view(grid, dataclasses.replace(view, stride=16)) is None


class Cloud(Field):
    """Thin, and of another colour everywhere."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return 2 + points.positions.sin().sum(-1), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return 0.5 + 0.5 * features.cos()


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("per_pixel", [1, 4])
def test_a_picture_is_the_same_with_rays_through_every_pixel(
    stride: int, per_pixel: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, method = Scene(BOX, 0.5, 20.0, 3, True, False, 200), load_method("instant-ngp")
    config, _ = method.decided(dataclasses.replace(method.config, eval_num_rays_per_chunk=5000), scene)
    model = RayModel(config, scene, Cloud(), sampler(), VolumeRenderer())
    model.register_parameter("any", torch.nn.Parameter(torch.zeros(1)))  # a model's device is its parameters'
    monkeypatch.setattr("nerfloom.samplers.in_view.MIN_PIXELS", 1)
    view, cast = View(camera((4.0, 1.0, 0.5)), rays_per_pixel=per_pixel, stride=stride), []  # type: ignore[arg-type]
    render = RayModel.render
    background = torch.tensor([1.0, 0.0, 1.0])

    def counted(self: RayModel, rays, behind):  # type: ignore[no-untyped-def]
        cast.append(len(rays))
        return render(self, rays, behind)

    monkeypatch.setattr(RayModel, "render", counted)
    quick, few = model.render_view(view, background), sum(cast)
    monkeypatch.setattr(RayModel, "_seen", lambda self, view: None)
    cast.clear()
    whole = model.render_view(view, background)
    assert sum(cast) == quick.num_rays == whole.num_rays
    assert few < 0.5 * sum(cast)
    assert bool((whole.accumulation > 0.1).any())
    for name in ("rgb", "depth", "median_depth", "accumulation"):
        assert torch.equal(getattr(quick, name), getattr(whole, name)), name
