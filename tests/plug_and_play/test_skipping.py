"""The functional grid and samples against plain quadrature and closed forms."""

import pytest
import torch
from torch import Tensor

import nerfloom
from benchmarks.closed_forms import BOX, scenes
from benchmarks.sampling import random_rays
from nerfloom.kernels import native
from tests.plug_and_play.scenes import BACKGROUND, dense_quadrature, functions, steps_through_box

STEPS = 256
SCENES = ("fog", "nested", "blobs", "sparse")


@pytest.fixture(params=["kernels", "torch alone"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The compiled kernels, and the references, as on every other device."""
    if request.param == "torch alone":
        monkeypatch.setattr(native, "available", lambda: False)
    return request.param


def picture(rays: nerfloom.Rays, name: str, grid: nerfloom.OccupancyGrid, early_stop: float) -> tuple[Tensor, int]:
    """Colours (R, 3) and the number of samples."""
    sigma_fn, rgb_sigma_fn = functions(name)
    samples = nerfloom.sample(rays, sigma_fn, grid, early_stop=early_stop)
    return nerfloom.render(rays, samples, rgb_sigma_fn, BACKGROUND).rgb, len(samples)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("name", SCENES)
def test_it_is_dense_quadrature_within_the_stated_bound(name: str) -> None:
    """A grid that knows nothing skips nothing; then the early stop alone may make a difference, as large as it says."""
    rays, grid = random_rays(500, seed=0), nerfloom.OccupancyGrid(BOX, 32, STEPS)
    truth = dense_quadrature(rays, functions(name)[1], grid.step_size)
    all_steps = int(steps_through_box(rays, grid.step_size)[1].sum())
    for early_stop in (0.0, 1e-4, 1e-2, 0.3):
        color, count = picture(rays, name, grid, early_stop)
        error = (color.double() - truth).abs().max().item()
        print(f"{name}, early stop {early_stop}: {count} of {all_steps} samples, colour off by {error:.1e}")
        # A step with its middle within rounding of a jump of density may fall on the other side.
        rounding = 2e-5 if name in ("fog", "blobs") else 2e-3
        assert error <= early_stop + rounding
        assert abs(count - all_steps) <= len(rays) * 1e-2 if early_stop == 0 else count <= all_steps * 1.01


@pytest.mark.parametrize("name", SCENES)
def test_the_early_stop_keeps_its_bound_exactly(name: str) -> None:
    """Both have the same steps, so that only the stop differs."""
    rays, grid = random_rays(2000, seed=1), nerfloom.OccupancyGrid(BOX, 32, STEPS)
    grid.fill(functions(name)[0])
    whole, count = picture(rays, name, grid, 0.0)
    for early_stop in (1e-4, 1e-2, 0.3):
        color, fewer = picture(rays, name, grid, early_stop)
        assert (color - whole).abs().max() <= early_stop + 1e-6
        assert fewer <= count
    assert fewer < 0.9 * count or name == "fog"


@pytest.mark.medium
@pytest.mark.parametrize(
    ("name", "least", "most"), [("sparse", 0.98, 1e-3), ("blobs", 0.9, 5e-3), ("nested", 0.6, 3e-3)]
)
def test_a_grid_that_was_filled_skips_what_is_empty(name: str, least: float, most: float) -> None:
    """At least `least` of all samples are left out, and colour is at most `most` (rms) worse than without."""
    torch.manual_seed(0)
    rays, grid = random_rays(2000, seed=2), nerfloom.OccupancyGrid(BOX, 64, STEPS)
    dense = dense_quadrature(rays, functions(name)[1], grid.step_size)
    truth = scenes()[name].truth(rays, BACKGROUND).color
    grid.fill(functions(name)[0])
    color, count = picture(rays, name, grid, 1e-4)
    skipped = 1 - count / int(steps_through_box(rays, grid.step_size)[1].sum())
    errors = [(one.double() - other).square().mean().sqrt().item() for one, other in ((color, truth), (dense, truth))]
    print(f"{name}: {skipped:.1%} skipped, colour off by {errors[0]:.1e} rms, of dense quadrature {errors[1]:.1e}")
    assert skipped > least
    assert errors[0] < errors[1] + most
    assert (color.double() - dense).abs().max() < 0.1


def test_updates_keep_a_grid_up() -> None:
    """A training loop has steps alone: a learnt ball is found, and matter that has moved away is forgotten."""
    torch.manual_seed(0)
    grid = nerfloom.OccupancyGrid(BOX, 16, 128)
    assert bool(grid.occupied.all())
    center = torch.tensor([0.5, 0.0, 0.0])

    def sigma_fn(positions: Tensor) -> Tensor:
        return 50.0 * ((positions - center).norm(dim=-1) < 0.3)

    for step in range(257):
        grid.update(step, sigma_fn)
    assert bool(grid.occupied[12, 8, 8])
    assert not bool(grid.occupied[3, 8, 8])
    assert 0.01 < grid.occupied.float().mean() < 0.1
    center[0] = -0.5
    for step in range(257, 5000):
        grid.update(step, sigma_fn)
    assert not bool(grid.occupied[12, 8, 8])
    assert bool(grid.occupied[3, 8, 8])


def test_near_and_far_ends_are_those_of_the_box_where_they_are_not_evaluated() -> None:
    rays, grid = random_rays(100, seed=3), nerfloom.OccupancyGrid(BOX, 8, 64)
    clipped = nerfloom.clip_to_box(rays, BOX)
    free = nerfloom.Rays(rays.origins, rays.directions)
    assert free.nears.tolist() == [0.0] * 100
    assert bool(free.fars.isinf().all())
    found = [nerfloom.sample(given, None, grid) for given in (rays, clipped, free)]
    for other in found[1:]:
        assert torch.equal(found[0].offsets, other.offsets)
        torch.testing.assert_close(found[0].t_starts, other.t_starts)
    half = nerfloom.Rays(rays.origins, rays.directions, fars=(clipped.nears + clipped.fars) / 2)
    assert len(nerfloom.sample(half, None, grid)) == pytest.approx(len(found[0]) / 2, rel=0.02)


def test_rays_may_be_of_float64() -> None:
    """The reference marches them; samples equal float32's, except for steps that lie on a face within rounding."""
    rays, grid = random_rays(300, seed=7), nerfloom.OccupancyGrid(BOX, 32, 128)
    double = nerfloom.Rays(rays.origins.double(), rays.directions.double())
    grid.fill(functions("nested")[0])
    one, other = (nerfloom.sample(given, functions("nested")[0], grid, early_stop=0.1) for given in (rays, double))
    assert other.t_starts.dtype == torch.float64
    assert abs(len(one) - len(other)) < 0.01 * len(one)
    pictures = [nerfloom.render(r, s, functions("nested")[1]).rgb.double() for r, s in ((rays, one), (double, other))]
    assert (pictures[0] - pictures[1]).abs().mean() < 1e-3


def test_jitter_moves_each_rays_steps_together() -> None:
    rays, grid = random_rays(500, seed=4), nerfloom.OccupancyGrid(BOX, 8, 64)
    enter = nerfloom.clip_to_box(rays, BOX).nears
    fixed, moved = (nerfloom.sample(rays, None, grid, jitter=jitter) for jitter in (False, True))
    firsts = [samples.t_starts[samples.offsets[:-1]] for samples in (fixed, moved)]
    torch.testing.assert_close(firsts[0], enter)
    shift = (firsts[1] - enter) / grid.step_size  # from -1, half a step being left out where its middle is outside
    assert -0.5 <= shift.min() < -0.4
    assert 0.4 < shift.max() <= 0.5
    torch.testing.assert_close(moved.deltas, torch.full_like(moved.deltas, grid.step_size), rtol=1e-3, atol=0)


@pytest.mark.usefixtures("backend")
def test_functions_of_time_see_the_time_of_their_ray() -> None:
    """A ball that has gone over to the other side: a ray finds it at one time, and not at the other."""
    torch.manual_seed(0)

    def sigma_fn(positions: Tensor, times: Tensor) -> Tensor:
        x = positions[:, 0] - (times - 0.5)
        return 60.0 * (x.square() + positions[:, 1:].square().sum(-1) < 0.2**2)

    def rgb_sigma_fn(positions: Tensor, directions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        return times[:, None].expand(-1, 3), sigma_fn(positions, times)

    grid = nerfloom.OccupancyGrid(BOX, 32, 256, moving=True)
    grid.fill(sigma_fn)
    assert bool(grid.occupied[8, 16, 16])
    assert bool(grid.occupied[16, 16, 16])
    assert bool(grid.occupied[24, 16, 16])
    assert not bool(grid.occupied[16, 28, 16])
    origins = torch.tensor([[-0.5, 0.01, 3.0], [-0.5, 0.01, 3.0], [0.5, 0.01, 3.0], [0.5, 0.01, 3.0]])
    rays = nerfloom.Rays(origins, torch.tensor([[0.0, 0.0, -1.0]]).expand(4, 3), times=torch.tensor([0.0, 1, 0, 1]))
    samples = nerfloom.sample(rays, sigma_fn, grid)
    picture = nerfloom.render(rays, samples, rgb_sigma_fn, 0.5)
    torch.testing.assert_close(picture.accumulation, torch.tensor([1.0, 0, 0, 1]), rtol=0, atol=1e-4)
    torch.testing.assert_close(picture.rgb[:, 0], torch.tensor([0.0, 0.5, 0.5, 1]), rtol=0, atol=1e-4)
    assert picture.depth[0].item() == pytest.approx(2.8, abs=0.03)


@pytest.mark.usefixtures("backend")
def test_an_empty_grid_and_no_rays() -> None:
    """The field's graph is still there, so that a loop's `backward` finds something to do."""
    parameter = torch.ones((), requires_grad=True)
    grid = nerfloom.OccupancyGrid(BOX, 8, 64)
    grid.carve(torch.zeros(8, 8, 8, dtype=torch.bool))
    assert not bool(grid.occupied.any())
    for rays in (random_rays(5, seed=0), random_rays(0, seed=0)):
        samples = nerfloom.sample(rays, lambda x: x[:, 0] * parameter, grid)
        assert (len(samples), samples.num_rays) == (0, len(rays))
        found = nerfloom.render(rays, samples, lambda x, d: (x * parameter, x[:, 0], {"own": x[:, :2]}), BACKGROUND)
        torch.testing.assert_close(found.rgb, BACKGROUND.expand(len(rays), 3))
        torch.testing.assert_close(found.depth, rays.fars)
        assert found.extras["own"].shape == (len(rays), 2)
        found.rgb.sum().backward()
        assert parameter.grad is not None
        assert parameter.grad.item() == 0


def test_carved_cells_stay_empty() -> None:
    torch.manual_seed(0)
    grid = nerfloom.OccupancyGrid(BOX, 8, 64)
    kept = torch.zeros(8, 8, 8, dtype=torch.bool)
    kept[2] = True  # a slab across x
    grid.carve(kept)
    grid.fill(lambda positions: torch.full_like(positions[:, 0], 9.0))
    assert torch.equal(grid.occupied, kept)
    samples = nerfloom.sample(rays := random_rays(200, seed=5), None, grid)
    x = samples.positions(rays)[:, 0]
    assert len(samples) > 100
    assert x.min() >= -0.5 - 1e-5
    assert x.max() <= -0.25 + 1e-5


def test_a_grid_is_saved_with_the_model_it_is_part_of() -> None:
    torch.manual_seed(0)
    grid, other = (nerfloom.OccupancyGrid(BOX, 16, 64) for _ in range(2))
    grid.fill(functions("sparse")[0])
    assert list(grid.parameters()) == []
    other.load_state_dict(grid.state_dict())
    assert torch.equal(other.occupied, grid.occupied)
    rays = random_rays(50, seed=6)
    assert torch.equal(nerfloom.sample(rays, None, other).t_starts, nerfloom.sample(rays, None, grid).t_starts)


def test_samples_need_no_gradient_and_rays_may_have_one() -> None:
    rays, grid = random_rays(10, seed=0), nerfloom.OccupancyGrid(BOX, 8, 64)
    moved = nerfloom.Rays(rays.origins.requires_grad_(), rays.directions)
    parameter = torch.ones((), requires_grad=True)
    samples = nerfloom.sample(moved, lambda x: parameter * x[:, 0].abs(), grid)
    assert samples.sigma is None
    assert not samples.t_starts.requires_grad
    nerfloom.render(moved, samples, lambda x, d: (x, parameter * x[:, 0].abs())).rgb.sum().backward()
    assert moved.origins.grad is not None
    assert moved.origins.grad.abs().min() > 0
    assert parameter.grad is not None


def test_what_is_wrong_is_said() -> None:
    rays, grid = random_rays(3, seed=0), nerfloom.OccupancyGrid(BOX, 8, 64)
    with pytest.raises(ValueError, match=r"density of shape \(\d+, 1\).*squeeze"):
        nerfloom.sample(rays, lambda x: x[:, :1], grid)
    with pytest.raises(ValueError, match="density of shape tuple"):
        grid.update(8, lambda x: (x[:, 0], x))
    with pytest.raises(ValueError, match=r"ray 0 has length 2.*must be 1"):
        nerfloom.sample(nerfloom.Rays(rays.origins, 2 * rays.directions), None, grid)
    with pytest.raises(ValueError, match=r"origins have shape \(1, 3, 3\)"):
        nerfloom.sample(nerfloom.Rays(rays.origins[None], rays.directions[None]), None, grid)
    timed = nerfloom.Rays(rays.origins, rays.directions, times=torch.zeros(3))
    with pytest.raises(ValueError, match="moving=True"):
        nerfloom.sample(timed, None, grid)
    with pytest.raises(ValueError, match="rays have no times"):
        nerfloom.sample(rays, None, nerfloom.OccupancyGrid(BOX, 8, 64, moving=True))
    with pytest.raises(ValueError, match="minimum and a maximum corner"):
        nerfloom.OccupancyGrid([[0, 0, 0], [1, 1, 0]])
    with pytest.raises(ValueError, match="1 to 512 cells"):
        nerfloom.OccupancyGrid(BOX, 1000)


def test_a_broken_density_is_not_skipped() -> None:
    rays, grid = random_rays(20, seed=0), nerfloom.OccupancyGrid(BOX, 8, 64)
    broken = lambda x: torch.full_like(x[:, 0], torch.nan)  # noqa: E731
    grid.fill(broken)
    assert bool(grid.occupied.all())
    samples = nerfloom.sample(rays, broken, grid)
    assert len(samples) == len(nerfloom.sample(rays, None, grid))
    assert bool(nerfloom.render(rays, samples, lambda x, d: (x, broken(x))).rgb.isnan().any(-1).all())
