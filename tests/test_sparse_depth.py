"""Sparse depth: from points that images see to pixels, batches and losses."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from nerfloom.base.device import seed_step
from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.batch import draw_batch, gather_batch
from nerfloom.data.sources import KEYPOINTS, PixelSource, Request, make_source
from nerfloom.data.sparse_depth import sparse_depth
from nerfloom.data.tracks import Sightings
from nerfloom.evaluation.evaluator import floaters
from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import weights_and_transmittance
from nerfloom.losses.functions import WRONG_SHARE, distance_likelihood
from nerfloom.rendering.rendered import Picture
from nerfloom.training.trainer import Trainer
from tests.training.helpers import assert_same_bits, tensors, tiny_run

LENSES = {
    "pinhole": None,
    "opencv": torch.tensor([0.1, -0.05, 0.002, -0.003, 0, 0, 0, 0, 0]),
    "fisheye": torch.tensor([0.05, -0.01, 0.0, 0.0]),
}


def cameras(model: str, count: int = 2) -> Cameras:
    """Cameras beside each other that look along -z, of 40 x 30 pixels."""
    poses = torch.eye(4)[:3].repeat(count, 1, 1)
    poses[:, 0, 3] = torch.arange(count) * 0.2
    one, lens = torch.ones(count), LENSES[model]
    sizes = (40 * one).long(), (30 * one).long()
    given = None if lens is None else lens.expand(count, -1)
    return Cameras(poses, 35 * one, 36 * one, 20.5 * one, 14.5 * one, *sizes, model, given)


@pytest.mark.parametrize("model", LENSES)
def test_a_point_is_where_its_pixels_ray_ends(model: str) -> None:
    """The error is below half a pixel's width at that distance, for every lens."""
    torch.manual_seed(0)
    points = torch.cat([torch.rand(200, 2) * 2 - 1, -1 - 4 * torch.rand(200, 1)], dim=-1)
    seen_by = cameras(model)
    images = torch.arange(200) % 2
    found = sparse_depth(Sightings(images, points, torch.full((200,), 0.01)), seen_by)
    assert 100 < len(found) < 200
    assert bool((found.pixels.diff() > 0).all())
    rays = seen_by.pixel_rays(found.pixels, 0.0, 10.0)
    ends = rays.origins + found.distances[:, None] * rays.directions
    assert rays.camera_indices is not None
    nearest = torch.cdist(ends, points).min(1)
    assert torch.equal(images[nearest.indices], rays.camera_indices)
    assert (nearest.values / found.distances).max() < 0.75 / 35


def test_the_best_known_of_several_points_in_a_pixel_counts_and_none_outside() -> None:
    points = torch.tensor([[0.0, 0, -2], [0, 0, -3], [0, 0, -4], [9.0, 0, -1], [0, 0, 2]])
    deviations = torch.tensor([0.2, 0.1, 0.3, 0.1, 0.1])
    found = sparse_depth(Sightings(torch.zeros(5, dtype=torch.int64), points, deviations), cameras("pinhole"))
    assert len(found) == 1
    assert found.distances.item() == pytest.approx(3.0, rel=1e-3)
    assert found.deviations.item() == pytest.approx(0.1)
    assert found.pixels.item() == 14 * 40 + 20


# -- the loss ---------------------------------------------------------------------------------------------------------


def ray(sigma: list[float], edges: list[float]) -> tuple[torch.Tensor, Samples, torch.Tensor]:
    """Densities of a ray's intervals, the samples, and the weights."""
    ends = torch.tensor([edges], dtype=torch.float64)
    samples = Samples.regular(ends[:, :-1], ends[:, 1:])
    density = torch.tensor(sigma, dtype=torch.float64, requires_grad=True)
    return density, samples, weights_and_transmittance(density, samples)[0]


def likelihood(weights: torch.Tensor, samples: Samples, distance: float, deviation: float) -> torch.Tensor:
    known = [torch.tensor([value], dtype=torch.float64) for value in (distance, deviation)]
    return distance_likelihood(weights, samples, *known)


def of_light(hit: float, behind: float, lost: float) -> float:
    """The term in closed form, of the light that is stopped at the point, behind it, and nowhere."""
    e = WRONG_SHARE
    return -math.log((hit + e * (hit + behind + lost) + e * e) / (1 + e + e * e))


def test_the_loss_in_closed_form() -> None:
    sigma, samples, weights = ray([0.3, 0.5, 2.0, 1.0], [1.0, 2.0, 3.0, 4.0, 5.0])
    loss = likelihood(weights, samples, 3.5, 0.1)  # from 3.2 to 3.8: the third interval
    before = math.exp(-0.8)
    hit, behind = before * (1 - math.exp(-2)), before * math.exp(-2) * (1 - math.exp(-1))
    assert loss.item() == pytest.approx(of_light(hit, behind, before * math.exp(-3)), rel=1e-9)
    (gradient,) = torch.autograd.grad(loss, sigma)
    e, scale = WRONG_SHARE, hit + WRONG_SHARE * before + WRONG_SHARE**2
    assert gradient[0].item() == gradient[1].item() == pytest.approx((hit + e * before) / scale, rel=1e-9)
    assert gradient[2].item() == pytest.approx(-before * math.exp(-2) / scale, rel=1e-9)
    assert gradient[3].item() == 0


def test_an_interval_that_the_window_meets_counts_whole() -> None:
    _, samples, weights = ray([0.0, 40.0, 0.0], [1.0, 2.0, 3.0, 4.0])
    for distance, deviation in ((2.5, 1e-6), (3.05, 0.1), (1.9, 0.1)):
        assert likelihood(weights, samples, distance, deviation).item() == pytest.approx(0, abs=1e-6)
    assert likelihood(weights, samples, 3.2, 0.01).item() > 5


def test_fog_before_a_point_is_cleared_however_dense_it_is() -> None:
    """The gradient of a mean of weights would vanish with the light that comes through."""
    for depth in (0.5, 2.0, 4.0):
        sigma, samples, weights = ray([depth, 50.0], [1.0, 2.0, 3.0])
        (gradient,) = torch.autograd.grad(likelihood(weights, samples, 2.5, 0.01), sigma)
        assert 0.9 < gradient[0].item() <= 1


def test_a_wrong_point_does_not_fight_a_wall() -> None:
    """A point behind a wall that all images show, or before it: the wall stays, and no matter is asked for."""
    sigma, samples, weights = ray([0.0, 60.0, 0.0], [1.0, 2.0, 3.0, 4.0])
    (behind,) = torch.autograd.grad(likelihood(weights, samples, 3.5, 0.01), sigma, retain_graph=True)
    assert behind.abs().max() < 1e-3
    (before,) = torch.autograd.grad(likelihood(weights, samples, 1.5, 0.01), sigma)
    assert before[1].abs() < 1e-3


def test_rays_without_a_point_and_rays_without_samples() -> None:
    samples = Samples(torch.tensor([1.0, 2.0]), torch.tensor([2.0, 3.0]), torch.tensor([0, 2, 2, 2]))
    weights = torch.tensor([0.25, 0.5], requires_grad=True)
    loss = distance_likelihood(weights, samples, torch.tensor([0.0, 0.0, 0.0]), torch.ones(3))
    assert loss.item() == 0
    loss = distance_likelihood(weights, samples, torch.tensor([2.5, 1.0, 0.0]), torch.full((3,), 1e-3))
    expected = (of_light(0.5, 0, 0.25) + of_light(0, 0, 1)) / 2
    assert loss.item() == pytest.approx(expected, rel=1e-5)
    (gradient,) = torch.autograd.grad(loss, weights)
    assert bool(gradient.isfinite().all())


# -- batches and training ---------------------------------------------------------------------------------------------


def ball_points(parsed, per_image: int = 40) -> Sightings:
    """Points on the unit ball of the tiny data set, as its images see them."""
    generator = torch.Generator().manual_seed(5)
    images = torch.arange(len(parsed.cameras)).repeat_interleave(per_image)
    points = torch.nn.functional.normalize(torch.randn(len(images), 3, generator=generator), dim=-1)
    towards = torch.nn.functional.normalize(parsed.cameras.camera_to_worlds[images, :, 3], dim=-1)
    points = torch.nn.functional.normalize(points + 2 * towards, dim=-1)  # on the side that is seen
    return Sightings(images, points, torch.full((len(images),), 0.01))


@pytest.fixture(scope="module")
def parsed(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory):
    run = tiny_run("nerfacto", shared_tiny, tmp_path_factory.mktemp("run"))
    scene = run.parser.parse(shared_tiny, "train")
    return dataclasses.replace(scene, sightings=ball_points(scene))


@pytest.fixture(scope="module")
def dataset(parsed) -> Dataset:
    return load_dataset(parsed, "train")


def test_keypoints_stand_last_in_a_batch_with_their_distances(dataset: Dataset) -> None:
    known = dataset.sparse_depth
    assert known is not None
    assert dataset.scene.num_sparse_depths == len(known) > 100
    batch = draw_batch(dataset, 64, "black", subpixels=subpixels(4), keypoints=16)
    assert batch.distances is not None
    assert batch.deviations is not None
    assert len(batch) == 64
    assert len(batch.rays) == 256
    assert batch.distances[:48].eq(0).all()
    places = torch.searchsorted(known.pixels, batch.pixels[48:])
    assert torch.equal(known.pixels[places], batch.pixels[48:])
    assert torch.equal(known.distances[places], batch.distances[48:])
    rays = dataset.cameras.pixel_rays(batch.pixels[48:], 0.0, 10.0)
    ends = rays.origins + batch.distances[48:, None] * rays.directions
    assert (ends.norm(dim=-1) - 1).abs().max() < 0.15
    same = gather_batch(dataset, batch.pixels, batch.background)
    assert torch.equal(same.rgb, batch.rgb)


def test_a_batch_without_keypoints_is_as_it_was(dataset: Dataset) -> None:
    """The pixels drawn evenly do not depend on other draws either."""
    batches = []
    for data, keypoints in ((dataclasses.replace(dataset, sparse_depth=None), 0), (dataset, 0), (dataset, 14)):
        seed_step(3, 7)
        batches.append(draw_batch(data, 50 + keypoints, "black", keypoints=keypoints))
    assert torch.equal(batches[0].pixels, batches[1].pixels)
    assert batches[1].distances is None
    assert torch.equal(batches[0].pixels, batches[2].pixels[:50])
    assert torch.equal(batches[0].rgb, batches[2].rgb[:50])


def test_a_source_draws_keypoints_where_they_count(dataset: Dataset, tmp_path: Path, shared_tiny: Path) -> None:
    run = tiny_run("nerfacto", shared_tiny, tmp_path)
    for mult, share in ((0.01, KEYPOINTS), (0.0, 0.0)):
        source = make_source("pixels", dataset, dataclasses.replace(run.config, depth_loss_mult=mult))
        assert isinstance(source, PixelSource)
        for drawn in (source, source.drawing_from(dataset)):
            distances = drawn.draw(Request(0, 80)).distances
            assert (0 if distances is None else int((distances > 0).sum())) == round(80 * share)
            assert drawn.draw(Request(0, 80, points=False)).distances is None
    measured = dataclasses.replace(dataset, scene=dataclasses.replace(dataset.scene, has_depth=True))
    source = make_source("pixels", measured, dataclasses.replace(run.config, depth_loss_mult=0.01))
    assert isinstance(source, PixelSource)
    assert source.keypoints == 0  # depth images know more


@pytest.mark.parametrize(
    "kind", ["nerfacto", "vanilla-nerf", "vanilla-nerf+occupancy", "instant-ngp", "kplanes", "tensorf", "dnerf"]
)
def test_every_method_that_casts_rays_learns_from_them(
    kind: str, dataset: Dataset, shared_tiny: Path, tmp_path: Path
) -> None:
    run = tiny_run(kind, shared_tiny, tmp_path)
    trainer = Trainer.of(run, dataset)
    said = [decision.line() for decision in trainer.decisions]
    count = dataset.scene.num_sparse_depths
    assert f"  depth loss: 0.001, as the reconstruction's points are seen in {count:,} pixels" in said
    report = trainer.train_step()
    assert report.losses["depth"] > 0
    assert ("depth_coarse" in report.losses) == (kind in ("vanilla-nerf", "dnerf"))
    off = Trainer.of(tiny_run(kind, shared_tiny, tmp_path, depth_loss_mult=0.0), dataset)
    assert "depth" not in off.train_step().losses


def test_points_teach_in_the_first_half_alone(dataset: Dataset, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = Trainer.of(tiny_run("nerfacto", shared_tiny, tmp_path, max_num_iterations=6), dataset)
    reports = [trainer.train_step() for _ in range(6)]
    assert ["depth" in report.losses for report in reports] == [True] * 3 + [False] * 3


@pytest.mark.medium
def test_points_teach_where_the_surface_is_and_that_space_before_it_is_empty(
    parsed, dataset: Dataset, shared_tiny: Path, tmp_path: Path
) -> None:
    """White pictures have no information, so only points teach the surface; without points nothing does."""
    blind = dataclasses.replace(dataset, pixels=torch.full_like(dataset.pixels, 255))
    found = []
    for mult in (0.0, 0.05):
        changes = {"max_num_iterations": 80, "max_eval_images": 0, "depth_loss_mult": mult}
        run = tiny_run("nerfacto", shared_tiny, tmp_path, **changes)
        run = dataclasses.replace(run, folder=tmp_path / f"{mult}")
        trainer = Trainer.of(run, blind)
        for _ in range(80):
            trainer.train_step()
        known = dataset.sparse_depth
        batch = gather_batch(blind, known.pixels, torch.ones(len(known), 3))
        with torch.no_grad():
            rendered = trainer.model.eval().render(batch.rays, batch.background)
        found.append(((rendered.median_depth - known.distances).abs() / known.distances).median().item())
    print("median relative error of depth without and with points:", found)
    assert found[1] < 0.05 < found[0]


def test_the_same_seed_gives_the_same_bits(dataset: Dataset, shared_tiny: Path, tmp_path: Path) -> None:
    """Also across a resume."""
    states = []
    for name in ("a", "b"):
        run = dataclasses.replace(tiny_run("nerfacto", shared_tiny, tmp_path), folder=tmp_path / name)
        (tmp_path / name).mkdir()
        trainer = Trainer.of(run, dataset)
        for step in range(8):
            if name == "b" and step == 4:
                content = trainer._content()
                trainer = Trainer.of(run, dataset)
                trainer.restore(content)
            trainer.train_step()
        states.append(tensors(trainer))
    assert_same_bits(*states)


# -- floaters ---------------------------------------------------------------------------------------------------------


def test_floaters_are_counted_by_the_median_depth(dataset: Dataset) -> None:
    known = dataset.sparse_depth
    assert known is not None
    start, end = dataset.cameras.ends[1:3]
    height, width = dataset.cameras.sizes[1]
    mine = known[(known.pixels >= start) & (known.pixels < end)]
    assert len(mine) > 4

    def share(factors: torch.Tensor) -> float | None:
        median = torch.zeros(height * width)  # pixels without a point are black holes, and do not count
        median[mine.pixels - start] = factors * mine.distances
        empty = torch.zeros(height, width)
        picture = Picture(empty[..., None].expand(-1, -1, 3), empty, median.view(height, width), empty)
        return floaters(picture, dataset, 1)

    factors = torch.ones(len(mine))
    assert share(factors) == 0
    assert share(1.5 * factors) == 0
    assert share(0.95 * factors) == 0
    factors[:3] = 0.85
    assert share(factors) == pytest.approx(300 / len(mine))
    assert share(0.5 * factors) == 100


def test_without_points_floaters_are_not_known(dataset: Dataset) -> None:
    height, width = dataset.cameras.sizes[0]
    empty = torch.zeros(height, width)
    picture = Picture(empty[..., None].expand(-1, -1, 3), empty, empty, empty)
    assert floaters(picture, dataclasses.replace(dataset, sparse_depth=None), 0) is None
    vague = dataclasses.replace(dataset.sparse_depth, deviations=0.05 * dataset.sparse_depth.distances)
    assert floaters(picture, dataclasses.replace(dataset, sparse_depth=vague), 0) is None
