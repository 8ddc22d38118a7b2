"""Two runs side by side: one view of two scenes with frames that differ by a similarity."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.geometry.regions import Box, Polygon
from nerfloom.methods.gaussian_splatting import GaussianSplatting, GaussianSplattingConfig, decide
from nerfloom.splats.gaussians import Gaussians
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.beside import check_beside, draw_beside, joined, with_divider
from nerfloom.viewer.drawing import draw
from nerfloom.viewer.pace import Piece
from nerfloom.viewer.request import Crop, Pose, Request

ABOVE = Pose((1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, -0.2, 0.0, 0.0, 1.0, 4.0), 1.2)
"""A camera 4 above the origin that looks down."""
ROTATION = torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], dtype=torch.float64)
SHIFT = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
SCALE = 2.0
WHOLE = Piece(1, 1, 0, 48)


def scene(size: float) -> Scene:
    """A scene with lengths `size` times as large."""
    box = size * torch.tensor([[-3.0] * 3, [3.0] * 3])
    return Scene(box, 0.1 * size, 20.0 * size, 4, True, False, 48, image_pixels=48 * 48)


def loaded(means: Tensor, radius: float, size: float, placement: Placement) -> Loaded:
    """Round Gaussians of three colours."""
    model = GaussianSplatting(decide(GaussianSplattingConfig(degree=0, max_seconds=10.0), scene(size))[0], scene(size))
    sizes, turns = torch.full((3, 3), radius).log(), torch.tensor([[1.0, 0, 0, 0]] * 3)
    light = 3.54 * torch.eye(3) - 1.77  # red, green, blue
    model.set_gaussians(Gaussians(means, sizes, turns, torch.full((3,), 4.0), light, torch.zeros(3, 3, 0)))
    return Loaded(model.eval(), placement, "gaussian-splatting", Path("splat.ply"), Path("splat.ply"))


MEANS = torch.tensor([[0.8, 0.2, 0.1], [-0.9, 0.3, -0.5], [0.1, -0.7, 0.4]])


@pytest.fixture
def here() -> Loaded:
    return loaded(MEANS, 0.4, 1.0, Placement(torch.eye(4).double()[:3], 1.0))


@pytest.fixture
def there() -> Loaded:
    """The same Gaussians in a scene that is turned, twice as large and elsewhere."""
    means = (SCALE * (MEANS.double() @ ROTATION.T) + SHIFT).float()
    return loaded(means, 0.8, SCALE, Placement(torch.cat([ROTATION, SHIFT[:, None] / SCALE], 1), SCALE))


FROM_X = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
"""The axes of a camera that looks along -x."""


@pytest.mark.parametrize(
    "crop",
    [
        None,
        Crop(Box((-2.0, -2.0, -1.0), (0.5, 2.0, 3.0)), near=0.5, far=4.3),
        Crop(Box((0,) * 3, (2,) * 3)),
        Crop(polygons=(Polygon((4.0, 0.0, 0.0), FROM_X, ((-0.1, -0.2), (0.3, -0.2), (0.3, 0.3)), keep=False),)),
    ],
)
@pytest.mark.parametrize("output", ["rgb", "depth"])
def test_what_is_the_same_looks_the_same_in_both_scenes(
    here: Loaded, there: Loaded, crop: Crop | None, output: str
) -> None:
    request = Request(ABOVE, 64, 48, output, crop=crop)
    alone = draw(here, request, WHOLE, None)
    for divider in (0.0, 0.4, 1.0):
        both = draw_beside(here, there, dataclasses.replace(request, divider=divider), WHOLE, None)
        assert both.keys() == alone.keys()
        visible = alone.get("accumulation", np.full((48, 64), 255)) > 200
        for name, values in alone.items():
            error = np.abs(both[name].astype(float) - values)[visible]
            assert error.mean() < 0.01 * max(float(np.abs(values).max()), 1.0), (name, divider)


def test_each_side_of_the_divider_is_of_its_run(here: Loaded, there: Loaded) -> None:
    behind = torch.tensor([[-50.0, 0.0, 50.0]] * 3)  # the camera
    other = loaded(behind, 0.1, SCALE, there.placement)
    request = Request(ABOVE, 64, 48, divider=0.25)
    found = draw_beside(here, other, request, WHOLE, None)["rgb"]
    alone = draw(here, request, WHOLE, None)["rgb"]
    np.testing.assert_array_equal(found[:, :16], alone[:, :16])
    assert (found[:, 16:] == 255).all()
    assert (alone[:, 16:] < 200).any()


def test_a_photograph_counts_for_both_runs(here: Loaded, there: Loaded) -> None:
    """It is known from the first run's camera; the second may have moved its own."""

    times = list[float | None]()

    def truth(view: View, rgb: Tensor, background: Tensor) -> Tensor | None:
        matrix = view.camera.camera_to_worlds[0].flatten().tolist()
        times.append(view.time)
        return torch.full_like(rgb, 0.25) if np.allclose(matrix, ABOVE.matrix) else None

    request = Request(ABOVE, 64, 48, overlay=1.0, divider=0.5)
    over = draw_beside(here, there, request, WHOLE, None, truth)["rgb"]
    assert np.unique(over).size == 1
    error = dataclasses.replace(request, output="error", overlay=0.0)
    both, alone = draw_beside(here, there, error, WHOLE, None, truth), draw(here, error, WHOLE, None, truth)
    assert list(both) == list(alone) == ["error"]
    assert np.abs(both["error"].astype(int) - alone["error"]).mean() < 10
    assert set(times) == {None}
    here.model.scene = dataclasses.replace(here.model.scene, moving=True)
    draw_beside(here, there, dataclasses.replace(request, time=0.25), WHOLE, None, truth)
    assert times[-2:] == [0.25, 0.25]  # of the first run, whether the second moves or not


def test_a_moving_run_beside_a_still_one_shows_its_time(
    here: Loaded, there: Loaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The panel of a still scene has no time; the other scene's time is then 0."""
    times = list[float | None]()

    def render(view: View, background: Tensor) -> Tensor:
        times.append(view.time)
        return background.expand(view.height, view.width, 3)

    there.model.scene = dataclasses.replace(there.model.scene, moving=True)
    monkeypatch.setattr(there.model, "render_rgb", render)
    for time in (None, 0.25):
        draw_beside(here, there, Request(ABOVE, 64, 48, time=time, divider=0.5), WHOLE, None)
    assert times == [0.0, 0.25]


def test_rays_move_with_the_scene() -> None:
    request = Request(ABOVE, 9, 7)
    rays, moved = (
        one.camera().pixel_rays(torch.arange(63), 0.1, 9.0) for one in (request, request.moved(ROTATION, SCALE, SHIFT))
    )
    torch.testing.assert_close(moved.directions.double(), rays.directions.double() @ ROTATION.T, atol=1e-6, rtol=0)
    origins = SCALE * rays.origins.double() @ ROTATION.T + SHIFT
    torch.testing.assert_close(moved.origins.double(), origins, atol=1e-5, rtol=0)


def test_joined_columns() -> None:
    left = {"depth": np.zeros((2, 5), np.float32), "accumulation": np.zeros((2, 5), np.uint8)}
    right = {"depth": np.ones((2, 5), np.float32), "accumulation": np.ones((2, 5), np.uint8)}
    for values in joined(left, right, 0.6).values():
        np.testing.assert_array_equal(values, [[0, 0, 0, 1, 1]] * 2)


def test_the_divider_is_a_line_of_two_pixels() -> None:
    black = np.zeros((3, 10, 3), np.uint8)
    assert (with_divider(black, 0.5).any(-1) == [[False] * 4 + [True] * 2 + [False] * 4]).all()
    for end in (0.0, 1.0):
        assert with_divider(black, end).any(-1).sum() == 3
    assert with_divider(black, None) is black
    assert not black.any()


def test_normalised_device_coordinates_are_refused(here: Loaded) -> None:
    model = loaded(MEANS, 0.4, 1.0, here.placement).model
    model.scene = dataclasses.replace(model.scene, warped=True)
    with pytest.raises(ConfigError, match="--ndc"):
        check_beside(here, dataclasses.replace(here, model=model))
