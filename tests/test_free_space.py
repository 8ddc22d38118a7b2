"""Space right before cameras: up to where it is taken to be empty, and the penalty on matter in it."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import load_dataset
from nerfloom.data.free_space import CLEAR_SHARE, MAX_SEEN_SHARE, STEPS, before_points, clear_distances, distances_alone
from nerfloom.data.sources import PixelSource, Request, make_source
from nerfloom.data.sparse_depth import SparseDepth
from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import weights_and_transmittance
from nerfloom.losses.functions import WRONG_SHARE, matter_before
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_run


def row(*places: float) -> Cameras:
    """Cameras of 40 x 40 pixels along x that look along -z, with 90 degrees from edge to edge."""
    poses = torch.eye(4)[:3].repeat(len(places), 1, 1)
    poses[:, 0, 3] = torch.tensor(places)
    one = torch.ones(len(places))
    return Cameras(poses, 20 * one, 20 * one, 20 * one, 20 * one, (40 * one).long(), (40 * one).long())


def test_two_cameras_side_by_side_see_together_from_a_distance() -> None:
    """Each sees [x - z, x + z] at depth z, so at a gap of g another sees the share 1 - g / (2 z) of it."""
    gap, near, far = 0.6, 0.05, 2.0
    found = distances_alone(row(0.0, gap), near, far)
    assert torch.equal(found[0], found[1])
    expected = gap / (2 * (1 - MAX_SEEN_SHARE))  # along the axis; slanted rays reach that depth a little later
    assert abs(found[0].item() - expected) < 0.4 * expected + (far - near) / STEPS


def test_cameras_that_look_apart_are_alone_and_those_in_one_place_never() -> None:
    apart = row(0.0, 0.0)
    turned = apart.camera_to_worlds.clone()
    turned[1, :, 0] *= -1
    turned[1, :, 2] *= -1
    assert distances_alone(dataclasses.replace(apart, camera_to_worlds=turned), 0.1, 2.0).tolist() == [2.0, 2.0]
    assert distances_alone(apart, 0.1, 2.0).tolist() == [0.0, 0.0]


def test_a_single_image_tells_of_no_free_space() -> None:
    """No other camera sees its scene either, so all of it would be called empty."""
    assert distances_alone(row(0.0), 0.1, 2.0).tolist() == [0.0]


def test_nearest_points_but_for_a_few() -> None:
    """Image 0 sees 100 points from 1 to 2, and two that are wrong; image 1 sees three points, which tell nothing."""
    cameras = row(0.0, 0.0, 0.0)
    distances = torch.cat([torch.tensor([0.1, 0.2]), torch.linspace(1, 2, 98), torch.full((3,), 0.5)])
    pixels = torch.cat([torch.arange(100), 1600 + torch.arange(3)])
    known = SparseDepth(pixels, distances, torch.full_like(distances, 0.01))
    expected = torch.tensor([CLEAR_SHARE, 0.0, 0.0])
    torch.testing.assert_close(before_points(cameras, known), expected)
    torch.testing.assert_close(clear_distances(cameras, known, 0.1, 1000.0), expected)


def test_no_rays_have_no_penalty() -> None:
    weights = torch.zeros(0, requires_grad=True)
    samples = Samples(torch.zeros(0), torch.zeros(0), torch.zeros(1, dtype=torch.int64))
    loss = matter_before(weights, samples, torch.zeros(0))
    loss.backward()
    assert loss.item() == 0


def test_the_penalty_in_closed_form() -> None:
    """The optical depth before the distance, with its gradient; a wall is not fought against."""
    edges = torch.tensor([[1.0, 2.0, 3.0, 4.0]], dtype=torch.float64)
    samples = Samples.regular(edges[:, :-1], edges[:, 1:])
    for clear, before in ((3.5, 0.8), (2.5, 0.3), (0.5, 0.0)):
        sigma = torch.tensor([0.3, 0.5, 2.0], dtype=torch.float64, requires_grad=True)
        weights = weights_and_transmittance(sigma, samples)[0]
        loss = matter_before(weights, samples, torch.tensor([clear], dtype=torch.float64))
        left = math.exp(-before)
        assert loss.item() == pytest.approx(-math.log((left + WRONG_SHARE) / (1 + WRONG_SHARE)), rel=1e-9)
        (gradient,) = torch.autograd.grad(loss, sigma)
        counts = torch.tensor([clear > 2, clear > 3, clear > 4], dtype=torch.float64)
        torch.testing.assert_close(gradient, counts * left / (left + WRONG_SHARE))
    sigma = torch.tensor([0.0, 30.0, 0.0], dtype=torch.float64, requires_grad=True)
    weights = weights_and_transmittance(sigma, samples)[0]
    loss = matter_before(weights, samples, torch.tensor([3.5], dtype=torch.float64))
    assert torch.autograd.grad(loss, sigma)[0].abs().max() < 1e-6


def test_a_pixel_has_its_cameras_distance_and_a_run_its_term(shared_tiny: Path, tmp_path: Path) -> None:
    run = tiny_run("nerfacto", shared_tiny, tmp_path, free_space_loss_mult=0.5)
    dataset = load_dataset(run.parser.parse(shared_tiny, "train"), "train")
    trainer = Trainer.of(run, dataset)
    assert isinstance(trainer.source, PixelSource)
    distances = distances_alone(dataset.cameras, dataset.scene.near, 2.0)
    batch = trainer.source.drawing_from(dataset).draw(Request(0, 32, 4))
    assert batch.clear is not None
    images = torch.searchsorted(dataset.cameras.offsets, batch.pixels, right=True) - 1
    assert torch.equal(batch.clear, distances[images])
    assert "free_space" in trainer.train_step().losses
    off = make_source("pixels", dataset, dataclasses.replace(trainer.config, free_space_loss_mult=0.0))
    assert isinstance(off, PixelSource)
    assert off.draw(Request(0, 8)).clear is None
