"""Flat Gaussians along surfaces: the terms by closed forms, pictures of normals, and their effect in training."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom import View
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.gaussian_model import NORMALS_FROM
from nerfloom.kernels.math import cross_matrix
from nerfloom.kernels.splats.blend import CHANNELS
from nerfloom.kernels.splats.project import rotation_matrices
from nerfloom.losses.depth_normals import normal_error, normals_of_distances
from nerfloom.splats.drawing import ray_directions, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.normals import with_normals
from nerfloom.splats.rasteriser import RASTERISER
from tests.splats.test_method import ball, camera
from tests.splats.test_what_images_differ_in import model_of, scattered
from tests.training.helpers import tiny_trainer

SIDE = 33
"""Width and height of the images, pixels."""
NORMAL = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64), dim=0)


def lenses() -> list[Cameras]:
    """Cameras with and without a lens, turned and moved."""
    bent = dataclasses.replace(camera("opencv"), lens=torch.tensor([[0.2, -0.1, 0.01, -0.02, 0, 0, 0, 0, 0]]))
    fisheye = dataclasses.replace(camera("fisheye"), lens=torch.tensor([[0.1, -0.05, 0.02, 0.0]]))
    turn = torch.linalg.matrix_exp(cross_matrix(torch.tensor([0.3, -0.2, 0.4])))
    pose = torch.cat([turn, torch.tensor([[0.4], [-0.3], [2.5]])], 1)[None]
    return [dataclasses.replace(one, camera_to_worlds=pose) for one in (camera(), bent, camera("fisheye"), fisheye)]


def directions() -> Tensor:
    """The rays of `camera`, which is at (0, 0, 3)."""
    return ray_directions(splat_camera(camera(), 0.1)).double()


def plane(normal: Tensor) -> Tensor:
    """The distances (H, W) of the plane through the origin along `directions`."""
    return -3 * normal[2] / (directions() @ normal)


def image_of_a_plane(opacity: float, angle: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """An image of a plane with drawn normals off by an angle: normals, distances, transmittance, directions."""
    aside = torch.nn.functional.normalize(torch.linalg.cross(NORMAL, torch.eye(3).double()[0]), dim=0)
    shown = math.cos(angle) * NORMAL + math.sin(angle) * aside
    through = torch.full((SIDE, SIDE), 1 - opacity, dtype=torch.float64)
    return opacity * shown.repeat(SIDE, SIDE, 1), opacity * plane(NORMAL), through, directions()


@pytest.mark.parametrize("reduced", [1, 2])
def test_rays_lead_to_the_pixels_that_they_go_through(reduced: int) -> None:
    size = SIDE // reduced
    at = reduced * (torch.arange(size) + 0.5) - 0.5
    rows, columns = torch.meshgrid(at, at, indexing="ij")
    for one in lenses():
        rays = ray_directions(splat_camera(one, 0.1, reduced=reduced))
        assert rays.shape == (size, size, 3)
        torch.testing.assert_close(rays.norm(dim=-1), torch.ones(size, size))
        found = one.project(one.camera_to_worlds[0, :, 3] + 2 * rays.view(-1, 3), 0)
        assert bool(found[2].all())
        torch.testing.assert_close(found[0].view(size, size), columns, atol=2e-3, rtol=0)
        torch.testing.assert_close(found[1].view(size, size), rows, atol=2e-3, rtol=0)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.2, 0.9), (-0.5, 0.4, 0.8)])
def test_normals_of_a_plane_are_its_own(normal: tuple[float, float, float]) -> None:
    true = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    found = normals_of_distances(plane(true), directions())
    torch.testing.assert_close(found, true.expand(SIDE - 2, SIDE - 2, 3), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("opacity", "angle"), [(1.0, 0.0), (0.8, 0.5), (0.6, math.pi)])
def test_the_error_of_normals_in_closed_form(opacity: float, angle: float) -> None:
    error = normal_error(*image_of_a_plane(opacity, angle))
    assert float(error) == pytest.approx(opacity * (1 - math.cos(angle)), abs=1e-9)


def test_normals_of_what_is_transparent_or_left_out_do_not_count() -> None:
    """Neither do their neighbours, because their normals depend on these distances."""
    assert float(normal_error(*image_of_a_plane(0.4, 0.5))) == 0
    expected = 0.8 * (1 - math.cos(0.5))
    normals, distances, through, rays = image_of_a_plane(0.8, 0.5)
    normals[10, 20] *= -1
    distances[10, 20] *= 50
    assert float(normal_error(normals, distances, through, rays)) > expected + 5e-4
    kept = torch.ones(SIDE, SIDE, dtype=torch.bool)
    kept[10, 20] = False
    assert float(normal_error(normals, distances, through, rays, kept)) == pytest.approx(expected, abs=1e-9)
    through[10, 20] = 0.9
    assert float(normal_error(normals, distances, through, rays)) == pytest.approx(expected, abs=1e-9)


def test_empty_images_have_neither_an_error_nor_a_gradient() -> None:
    distances, rays = torch.zeros(SIDE, SIDE, requires_grad=True), directions().float()
    error = normal_error(torch.zeros(SIDE, SIDE, 3), distances, torch.ones(SIDE, SIDE), rays)
    error.backward()
    assert float(error.detach()) == 0
    assert distances.grad is not None
    assert not distances.grad.any()  # NaN would count


def test_normals_are_drawn_as_pictures_show_them() -> None:
    gaussians = scattered()
    log_scales = gaussians.log_scales + 0.5 * torch.randn(len(gaussians), 3)
    gaussians = dataclasses.replace(gaussians, log_scales=log_scales, rotations=torch.randn(len(gaussians), 4))
    for one in lenses():
        view = splat_camera(dataclasses.replace(one, camera_to_worlds=camera().camera_to_worlds), 0.1)
        with torch.no_grad():
            shown = RASTERISER.project(gaussians, view)
            true = RASTERISER.draw(shown, view, torch.zeros(3), CHANNELS["normals"]).image[..., 4:]
            found = RASTERISER.draw(with_normals(shown, gaussians, view), view, torch.zeros(3)).image
        torch.testing.assert_close(found, true, atol=1e-5, rtol=0)
        assert float(true.abs().max()) > 0.5


def test_drawn_normals_have_the_gradient_of_finite_differences() -> None:
    """The gradients by rotations and positions are compared, in float64; no Gaussian is nearly edge-on."""
    torch.manual_seed(3)
    size = torch.tensor([9])
    small = Cameras(camera().camera_to_worlds, *(torch.tensor([v]) for v in (10.0, 10.0, 4.5, 4.5)), size, size)
    view = splat_camera(small, 0.1)
    log_scales = torch.tensor([[0.9, 0.7, 0.05]], dtype=torch.float64).log().repeat(4, 1)
    logits, colors = torch.linspace(-1, 1, 4, dtype=torch.float64), torch.zeros(4, 3, dtype=torch.float64)
    means = (0.2 * torch.randn(4, 3, dtype=torch.float64)).requires_grad_()
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    rotations = (upright + 0.1 * torch.randn(4, 4, dtype=torch.float64)).requires_grad_()

    def image(rotations: Tensor, means: Tensor) -> Tensor:
        gaussians = Gaussians(means, log_scales, rotations, logits, colors, torch.zeros(4, 3, 0, dtype=torch.float64))
        colored = with_normals(RASTERISER.project(gaussians, view), gaussians, view)
        return RASTERISER.draw(colored, view, torch.zeros(3, dtype=torch.float64)).image

    inputs = rotations, means
    assert torch.autograd.gradcheck(image, inputs, nondet_tol=1e-9, check_undefined_grad=False, fast_mode=True)


def photograph() -> ViewBatch:
    """Noise, for `camera`."""
    generator = torch.Generator().manual_seed(6)
    return ViewBatch(0, View(camera()), torch.rand(SIDE, SIDE, 3, generator=generator), torch.zeros(3))


def test_the_smallest_scale_is_penalised_in_extents() -> None:
    """Only the last of the ball's scales 0.2, 0.2 and 0.01 gets a gradient; it is the gradient of its logarithm."""
    model = model_of(ball(), camera(), flatness_penalty=2.0)
    term, expected = model.loss(photograph(), 0).terms["flatness"], 2.0 * 0.01 / float(model.extent)
    assert float(term.detach()) == pytest.approx(expected)
    term.backward()
    gradient = model.columns["log_scales"].values.grad
    assert gradient is not None
    torch.testing.assert_close(gradient, torch.tensor([[0.0, 0.0, expected]]))
    assert "flatness" not in model_of(ball(), camera()).loss(photograph(), 0).terms


def test_of_equal_scales_one_is_penalised() -> None:
    model = model_of(scattered(), camera(), flatness_penalty=1.0)
    model.loss(photograph(), 0).terms["flatness"].backward()
    gradient = model.columns["log_scales"].values.grad
    assert gradient is not None
    assert torch.equal((gradient > 0).sum(1), torch.ones(60, dtype=torch.long))


def test_normals_count_after_their_share_of_the_budget_and_leave_colours_alone() -> None:
    plain, aligned = (model_of(ball(), camera(), normal_loss_mult=weight) for weight in (0.0, 0.5))
    plain.progress = 1.0
    assert "normals" not in plain.loss(photograph(), 0).terms
    for progress, expected in ((0.0, False), (NORMALS_FROM, True), (1.0, True)):
        aligned.progress = progress
        terms = aligned.loss(photograph(), 0).terms
        assert ("normals" in terms) is expected
        torch.testing.assert_close(terms["rgb"], plain.loss(photograph(), 0).terms["rgb"])


def leaning_sheet() -> Gaussians:
    """121 discs in the plane z = 0, each leaning by 0.3 radians in some direction."""
    torch.manual_seed(5)
    at = torch.linspace(-0.6, 0.6, 11)
    x, y = torch.meshgrid(at, at, indexing="ij")
    means = torch.stack([x, y, torch.zeros_like(x)], -1).view(-1, 3)
    about = torch.nn.functional.normalize(torch.randn(len(means), 2), dim=-1)
    cosines, nothing = torch.full((len(means), 1), math.cos(0.15)), torch.zeros(len(means), 1)
    rotations = torch.cat([cosines, math.sin(0.15) * about, nothing], 1)
    log_scales = torch.tensor([[0.12, 0.12, 0.01]]).log().repeat(len(means), 1)
    logits, colors = torch.full((len(means),), 3.0), torch.ones(len(means), 3)
    return Gaussians(means, log_scales, rotations, logits, colors, torch.zeros(len(means), 3, 0))


@pytest.mark.medium
def test_gaussians_turn_along_the_surface_that_they_show() -> None:
    """The plane of their centres, which the distances are of."""
    sheet = leaning_sheet()
    model = model_of(sheet, camera(), normal_loss_mult=1.0)
    model.progress = 1.0
    inner = (sheet.means[:, :2].abs() <= 0.4).all(1)
    rotations = model.columns["rotations"].values
    optimizer = torch.optim.Adam([rotations], lr=0.01)

    def angle() -> float:
        shortest = rotation_matrices(rotations.detach())[inner][:, :, 2]
        return float(shortest[:, 2].clamp(-1, 1).acos().mean())

    before = angle()
    for step in range(60):
        optimizer.zero_grad()
        model.loss(photograph(), step).terms["normals"].backward()
        optimizer.step()
    print(f"leaning by {before:.3f}, then by {angle():.3f}")
    assert before == pytest.approx(0.3, abs=1e-3)
    assert angle() < 0.15


def test_a_run_with_all_terms(shared_tiny: Path, tmp_path: Path) -> None:
    """Growth and changes of the number included."""
    weights = {"flatness_penalty": 1.0, "normal_loss_mult": 0.05, "distortion_loss_mult": 10.0}
    settings: dict[str, Any] = {**weights, "max_num_iterations": 40}
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path, **settings)
    for _ in range(25):
        trainer.train_step()
    assert trainer.state.skipped == 0
    assert all(bool(parameter.isfinite().all()) for parameter in trainer.model.parameters())
