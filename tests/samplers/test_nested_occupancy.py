"""The occupancy sampler in nested boxes: all of space is sampled, and the sky is opaque."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.scene import Scene
from nerfloom.fields.base import Field
from nerfloom.geometry.bounds import nested_boxes
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.compositing.density import composite
from nerfloom.kernels.march.occupancy import own_cells
from nerfloom.samplers.choice import SamplingConfig, contracted_box, make_sampler
from nerfloom.samplers.occupancy import ENDLESS_FAR, WARM_UP_STEPS, OccupancySampler
from nerfloom.scene.seen_cells import seen_cells
from nerfloom.training.checkpoint import load_newest
from nerfloom.training.trainer import Trainer
from tests.training.helpers import tiny_run, tiny_trainer

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
LEVELS, RESOLUTION = 5, 16
CAPTURE = Scene(BOX, 0.05, 1000.0, 3, has_alpha=False, moving=False, image_size=64, unbounded=True)


class Shells(Field):
    """Fog in the shells around the origin between given radii, with their numbers as colours."""

    def __init__(self, *shells: tuple[float, float, float]) -> None:
        super().__init__()
        self.shells = shells
        self.positions: list[torch.Tensor] = []

    def density(self, points: Points):
        self.positions.append(points.positions)
        far, sigma = points.positions.norm(dim=-1), torch.zeros(len(points))
        number = torch.zeros(len(points))
        for index, (low, high, density) in enumerate(self.shells):
            inside = (far >= low) & (far < high)
            sigma, number = sigma + density * inside, number + (index + 1) * inside
        return sigma, number[:, None].expand(-1, 3)

    def color(self, features, directions, camera_indices=None):
        return features / len(self.shells)


def sampler(**changes) -> OccupancySampler:
    settings = {"resolution": RESOLUTION, "num_steps": 200, "cone": 1 / 64, "levels": LEVELS, "endless": True}
    return OccupancySampler(BOX, **{**settings, "early_stop": 0.0, **changes})


def rays_from_the_middle(count: int = 100) -> Rays:
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    origins = 0.5 * torch.rand(count, 3, generator=generator)
    return Rays(origins, directions, torch.full((count,), 0.05), torch.full((count,), 1000.0))


def rendered(made: OccupancySampler, field: Field, rays: Rays, jitter: bool = False):
    samples = made.sample(rays, field, jitter)
    colors = field.color(samples.features, None)
    return samples, composite(samples, samples.sigma, colors, torch.full((3,), 7.0), rays.fars)


@pytest.mark.parametrize("jitter", [False, True])
def test_fog_at_all_distances_is_the_closed_form(jitter: bool) -> None:
    """Optical depths of shells that lie in different boxes: 0.4 near, 0.7 far off; and the sky behind is opaque."""
    torch.manual_seed(0)
    field = Shells((0.8, 1.2, 1.0), (6.0, 13.0, 0.1), (100.0, 1e12, 1e-3))
    rays = dataclasses.replace(rays_from_the_middle(), origins=torch.zeros(100, 3))
    samples, out = rendered(sampler(), field, rays, jitter)
    near, far = math.exp(-0.4), math.exp(-0.7)
    expected = ((1 - near) * 1 + near * (1 - far) * 2 + near * far * 3) / 3
    torch.testing.assert_close(out.opacity, torch.ones(100), rtol=0, atol=1e-6)
    torch.testing.assert_close(out.color, torch.full((100, 3), expected), rtol=0, atol=0.02)
    last = samples.offsets[1:] - 1
    assert bool((samples.t_ends[last] == ENDLESS_FAR).all())
    assert bool((samples.t[last] > 500).all())
    inner = samples.ranks[1:] > 0
    inner[last - 1] = False  # the last starts where the box ends, and the step before may not
    torch.testing.assert_close(samples.t_ends[:-1][inner], samples.t_starts[1:][inner])


def test_without_an_end_rays_that_meet_nothing_have_one_sample() -> None:
    made, rays = sampler(), rays_from_the_middle()
    made.occupied.zero_()
    made.forget()
    samples, out = rendered(made, Shells((100.0, 1e12, 1e-3)), rays)
    assert samples.counts.tolist() == [1] * 100
    torch.testing.assert_close(out.color, torch.ones(100, 3))
    ended = sampler(endless=False)
    ended.carve(torch.zeros_like(ended.occupied))
    assert len(ended.sample(rays, Shells((0.0, 1.0, 1.0)), False)) == 0
    assert len(made.sample(rays[:0], Shells((0.0, 1.0, 1.0)), True)) == 0


def test_a_wall_hides_the_sky() -> None:
    """Rays that end early have no last sample, and differ from other rays by less than the threshold."""
    field, rays = Shells((2.0, 3.0, 30.0), (100.0, 1e12, 1e-3)), rays_from_the_middle()
    exact = rendered(sampler(), field, rays)[1].color
    field.positions.clear()
    stopped, out = rendered(sampler(early_stop=1e-3), field, rays)
    assert float(torch.cat(field.positions).norm(dim=-1).max()) < 100
    assert bool((stopped.t_ends < 20).all())
    assert float((out.color - exact).abs().max()) <= 1e-3 * 7


def test_gradients_reach_all_samples_and_the_last() -> None:
    """The gradient by the density's scale is compared with one evaluation of all samples."""
    scale = torch.ones((), requires_grad=True)

    class Scaled(Shells):
        def density(self, points: Points):
            sigma, features = super().density(points)
            return scale * sigma, features

    field, rays = Scaled((0.8, 1.2, 1.0), (6.0, 13.0, 0.1), (20.0, 1e12, 1e-11)), rays_from_the_middle(20)
    made = sampler()
    samples, out = rendered(made, field, rays)
    (found,) = torch.autograd.grad(out.color.sum(), scale)
    sigma, features = field.density(Points(samples.positions(rays)))
    again = composite(samples, sigma, field.color(features, None), torch.full((3,), 7.0), rays.fars)
    torch.testing.assert_close(out.color, again.color)
    torch.testing.assert_close(found, torch.autograd.grad(again.color.sum(), scale)[0])


def test_the_grid_learns_matter_in_every_box() -> None:
    """A ball in the middle, and a far one in the fourth box; a smaller box's cells are not asked for in larger ones."""
    made, asked = sampler(), []
    center = torch.tensor([6.0, 0.0, 0.0])

    def density(points: Points):
        asked.append(points.positions)
        near, far = points.positions.norm(dim=-1) < 0.5, (points.positions - center).norm(dim=-1) < 1.9
        return 50.0 * near + 10.0 * far, points.positions

    for step in range(WARM_UP_STEPS + 33):
        torch.manual_seed(step)
        made.update(step, density)
    boxes = nested_boxes(BOX, LEVELS)
    cells = (torch.cartesian_prod(*[torch.arange(RESOLUTION)] * 3) + 0.5) / RESOLUTION
    occupied = made.occupied.view(LEVELS, -1)
    own = own_cells(LEVELS, RESOLUTION).view(LEVELS, -1)
    assert not bool((occupied & ~own).any())
    for level, (low, high) in enumerate(boxes):
        centers, diagonal = torch.lerp(low, high, cells), float((high - low).norm()) / RESOLUTION / 2
        to_near, to_far = centers.norm(dim=-1) - 0.5, (centers - center).norm(dim=-1) - 1.9
        inside = (to_near.minimum(to_far) < -diagonal) & own[level]
        outside = to_near.minimum(to_far) > diagonal
        assert bool(occupied[level][inside].all()), level
        assert not bool(occupied[level][outside].any()), level
        assert bool(inside.any()) == (level in (0, 3))
    places = torch.cat(asked).abs().amax(-1)
    assert float(places.max()) > 8
    assert len(places) < 5 * made.occupied.numel()


def test_a_cell_counts_by_the_step_that_crosses_it() -> None:
    """Thin fog is nothing in the small steps of the smallest box, and opaque in the long ones far away."""
    made = sampler(num_steps=1000)
    made.alpha_threshold = 0.01
    made.density_grid.fill_(0.5)
    made.density_grid[:100] = 1e4  # so that the mean is above the threshold
    density = lambda points: (torch.full((len(points),), 0.5), points.positions)  # noqa: E731
    made.update(WARM_UP_STEPS, density)
    occupied, own = made.occupied.view(LEVELS, -1), own_cells(LEVELS, RESOLUTION).view(LEVELS, -1)
    steps = made._step_sizes()
    assert steps[-1] == pytest.approx(2.0 ** (LEVELS - 1) / 64)
    assert -math.expm1(-0.5 * steps[0]) < 0.01
    assert int(occupied[0].sum()) <= 200
    assert bool(occupied[2:][own[2:]].all())


def test_state_survives_a_checkpoint() -> None:
    made, copy = sampler().eval(), sampler().eval()
    for step in range(200):
        torch.manual_seed(step)
        made.update(step, lambda points: (30.0 * (points.positions.norm(dim=-1) < 1.5), points.positions))
    copy.load_state_dict(made.state_dict())
    rays, field = rays_from_the_middle(), Shells((100.0, 1e12, 1e-3))
    first, second = (each.sample(rays, field, False) for each in (made, copy))
    assert torch.equal(made.occupied, copy.occupied)
    assert 0 < float(made.occupied.float().mean()) < 0.5
    for name in ("t_starts", "t_ends", "offsets"):
        assert torch.equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize(("levels", "resolution"), [(0, 16), (17, 16), (2, 18)])
def test_what_cannot_be_nested_is_refused(levels: int, resolution: int) -> None:
    with pytest.raises(ConfigError, match="nested"):
        OccupancySampler(BOX, resolution, levels=levels)


def test_the_choice_for_a_capture() -> None:
    config = SamplingConfig(sampler="occupancy", grid_levels=12, num_steps=100)
    made = make_sampler(config, CAPTURE)
    assert isinstance(made, OccupancySampler)
    assert (made.levels, made.resolution, made.endless, made.cone) == (11, 64, True, 1 / 64)  # 2^10 > 1000
    assert torch.equal(contracted_box(config, CAPTURE), BOX)
    boxed = dataclasses.replace(CAPTURE, unbounded=False)
    made = make_sampler(config, boxed)
    assert (made.levels, made.resolution, made.endless, made.cone) == (1, 128, False, 0.0)
    assert contracted_box(config, boxed) is None
    near = dataclasses.replace(CAPTURE, far=3.0, has_alpha=True)
    made = make_sampler(config, near)
    assert (made.levels, made.endless) == (3, False)


@pytest.mark.parametrize(("far", "levels"), [(0.5, 1), (1.0, 1), (2.0, 2), (1000.0, 11), (1e30, 12), (math.inf, 12)])
def test_boxes_reach_the_far_end_as_far_as_there_may_be_boxes(far: float, levels: int) -> None:
    config = SamplingConfig(sampler="occupancy", grid_levels=12)
    made = make_sampler(config, dataclasses.replace(CAPTURE, far=far))
    assert isinstance(made, OccupancySampler)
    assert made.levels == levels


def test_cells_that_no_camera_shows() -> None:
    """One camera at the origin that looks along -z: cells behind it are not seen, nor cells too near before it."""
    pose = torch.eye(3, 4)[None]
    size = torch.tensor([40])
    cameras = Cameras(pose, *[torch.tensor([v]) for v in (20.0, 20.0, 20.0, 20.0)], size, size)
    centers = (torch.cartesian_prod(*[torch.arange(64)] * 3) + 0.5) / 32 - 1
    seen = seen_cells(cameras, torch.tensor([0.6]), BOX, 64)
    x, y, z = centers.unbind(-1)
    shown = (z < 0) & (x.abs() < -z) & (y.abs() < -z)
    far = centers.norm(dim=-1)
    assert bool(seen[shown & (far > 0.6)].all())
    assert not bool(seen[z > 0.2].any())
    assert not bool(seen[far < 0.35].any())
    assert not bool(seen[(x.abs() > -z + 0.7) & (far > 0.6)].any())


def test_a_wide_lens_shows_more_beside_its_middle() -> None:
    """A ball 76 degrees from the axis is 17 times as large on the image as in its middle."""
    size = torch.tensor([40])
    cameras = Cameras(torch.eye(3, 4)[None], *[torch.tensor([v]) for v in (7.0, 7.0, 20.0, 20.0)], size, size)
    x, y, z = ((torch.cartesian_prod(*[torch.arange(64)] * 3) + 0.5) / 32 - 1).unbind(-1)
    shown = (z < 0) & (x.abs() < -z * 20 / 7) & (y.abs() < -z * 20 / 7)
    assert bool(seen_cells(cameras, torch.tensor([0.0]), BOX, 64)[shown].all())


def captured(method: str, data: Path, folder: Path, **facts: object) -> Trainer:
    """A trainer on the tiny data set as if its scene had no bounds."""
    settings = {"sampler": "occupancy", "grid_levels": 4, "num_steps": 400}
    still = tiny_trainer("instant-ngp", data, folder / "still").train_set
    (folder / "run").mkdir()
    scene = dataclasses.replace(still.scene, unbounded=True, far=100.0, **facts)
    run = tiny_run(method, data, folder / "run", **settings, max_eval_images=0, samples_per_batch=2**14)
    return Trainer.of(run, dataclasses.replace(still, scene=scene))


@pytest.mark.medium
@pytest.mark.parametrize("method", ["nerfacto", "instant-ngp"])
def test_a_capture_is_learnt_and_its_grid_kept(method: str, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = captured(method, shared_tiny, tmp_path)
    first = trainer.train_step().losses["rgb"]
    for _ in range(80):
        report = trainer.train_step()
    assert report.losses["rgb"] < 0.7 * first
    grid = trainer.model.sampler
    assert (grid.levels, grid.resolution, trainer.model.field.unbounded) == (4, 64, True)
    own = own_cells(4, 64)
    assert 0 < int(grid.occupied.sum()) < 0.9 * int(own.sum())  # silhouettes alone show a part to be empty
    trainer.save()
    again = captured(method, shared_tiny, tmp_path / "again")
    again.restore(load_newest(trainer.checkpoint_folder))
    assert torch.equal(again.model.sampler.occupied, grid.occupied)
    assert torch.equal(again.model.sampler.density_grid, grid.density_grid)


def test_the_profile_of_a_marched_capture(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = captured("nerfacto", shared_tiny, tmp_path)
    found = {d.option: d.choice for d in trainer.profile.decisions}
    assert (found["contraction"], found["distortion loss"]) == ("on", "0.002")
