"""The benchmark of samplers, on few rays: errors fall as expected, bounds hold, evaluations are counted."""

import json
import math
from functools import cache, partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks import error_curves, quadrature, sampling
from benchmarks.closed_forms import Block, ClosedForm, Medium, Solids, scenes
from benchmarks.error_curves import Curve, evaluations_needed
from benchmarks.quadrature import Row, Sizes, measured, skipping
from benchmarks.sampling import (
    WHITE,
    filled_grid,
    fitted_proposals,
    full_grid,
    marched,
    random_rays,
    renderers,
    sampled,
)
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.samplers.proposal import ProposalSampler
from nerfloom.samplers.uniform import UniformSampler

TINY = Sizes(counts=(8, 16), rays=64, skipping_rays=100, fit_steps=4, grid_resolution=16)


def errors_of_even_samples(scene: ClosedForm, rays: Rays, counts: tuple[int, ...]) -> list[float]:
    """Mean errors of one sample in the middle of each of `counts` equal intervals."""
    truth = scene.truth(rays, WHITE).color
    render = [partial(sampled, scene, UniformSampler(count), False) for count in counts]
    return [measured("", "", n, r, rays, truth).mean_error for n, r in zip(counts, render, strict=True)]


def test_even_samples_are_of_second_order_within_fog() -> None:
    """Rays that begin and end in it meet no jump."""
    fog = Solids(Medium(Block((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), 5.0, (0.5, 0.5, 0.5), (0.4, 0.4, 0.4)))
    towards = random_rays(200, seed=0).directions
    origins = towards.flip(0) * 0.2
    rays = Rays(origins, towards, torch.zeros(200), torch.full((200,), 0.7))
    errors = errors_of_even_samples(fog, rays, (8, 16, 32))
    print("within fog, 8, 16 and 32 samples: colour off by " + ", ".join(f"{error:.2e}" for error in errors))
    assert 3.7 < errors[0] / errors[1] < 4.3
    assert 3.6 < errors[1] / errors[2] < 4.4


def test_even_samples_are_of_second_order_in_smooth_matter() -> None:
    errors = errors_of_even_samples(scenes()["blobs"], random_rays(512, seed=1), (128, 256, 512))
    print("blobs, 128, 256 and 512 samples: colour off by " + ", ".join(f"{error:.2e}" for error in errors))
    assert errors[1] < errors[0] / 3
    assert errors[2] < errors[1] / 3


@pytest.mark.parametrize("name", ["fog", "nested"])
def test_even_samples_are_of_first_order_where_density_jumps(name: str) -> None:
    errors = errors_of_even_samples(scenes()[name], random_rays(512, seed=2), (128, 1024))
    print(f"{name}, 128 and 1024 samples: colour off by {errors[0]:.2e}, {errors[1]:.2e}")
    assert errors[1] < errors[0] / 4


@pytest.fixture(scope="module")
def proposals() -> ProposalSampler:
    torch.manual_seed(0)
    return ProposalSampler(sampling.BOX, log2_table_size=10).eval()


@torch.no_grad()
def test_evaluations_are_counted(proposals: ProposalSampler) -> None:
    scene, rays, count = scenes()["shell"], random_rays(200, seed=3), 16
    asked = {}
    for name, render in renderers(scene, proposals, full_grid, count).items():
        picture = render(rays)
        assert picture.color.shape == (200, 3)
        assert bool(torch.isfinite(picture.color).all())
        asked[name] = (picture.evaluations / 200, picture.coarse_evaluations / 200)
    assert asked["uniform"] == asked["stratified"] == (4 * count, 0)
    assert asked["hierarchical"] == (3 * count, count)
    assert asked["proposal"] == (count, 6 * count)
    assert asked["even steps"] == asked["occupancy"]  # a full grid here
    assert 0 < asked["even steps"][0] < 8 * count
    assert asked["early stop"][0] < asked["occupancy"][0]
    assert asked["early stop"][1] == 0


@torch.no_grad()
def test_what_waves_drop_is_counted_too() -> None:
    """The field is evaluated for whole waves, although light may reach their first sample alone."""
    wall = Solids(Medium(Block((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), 1e4))
    rays = Rays(torch.tensor([[-3.0, 0.0, 0.0]]), torch.eye(3)[:1], torch.zeros(1), torch.full((1,), 9.0))
    assert marched(wall, full_grid(512), 1e-4, rays).evaluations == 8


@pytest.mark.medium
def test_every_sampler_comes_near_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, rays = scenes()["nested"], random_rays(256, seed=4)
    monkeypatch.setattr(sampling, "FIT_RAYS", 128)
    fitted, seconds = fitted_proposals(scene, 60, seed=0)
    assert seconds > 0
    truth = scene.truth(rays, WHITE).color
    with torch.no_grad():
        for name, render in renderers(scene, fitted, cache(partial(filled_grid, scene, 32, 0)), 64).items():
            torch.manual_seed(0)
            error = measured("nested", name, 64, render, rays, truth).mean_error
            print(f"nested, {name}: colour off by {error:.1e}")
            assert error < 2e-2


@pytest.mark.medium
@torch.no_grad()
@pytest.mark.parametrize("name", ["nested", "shell"])
def test_early_stop_keeps_its_bound_and_saves(name: str) -> None:
    scene = scenes()[name]
    found = skipping(name, scene, filled_grid(scene, 32, 0, quadrature.STEPS), 3000, seed=0)
    cells, stops = found[0], found[1:]
    assert (cells.skipped, cells.bound, cells.kept) == ("empty cells", None, None)
    assert cells.evaluations < cells.evaluations_without
    assert [stop.bound for stop in stops] == list(quadrature.THRESHOLDS)
    for stop in stops:
        print(f"{name}, early stop at {stop.bound:g}: colour off by at most {stop.max_error:.1e}")
        assert stop.kept
        assert 0 < stop.mean_error <= stop.max_error <= stop.bound
        assert stop.evaluations < stop.evaluations_without == cells.evaluations


def test_a_broken_bound_and_a_nan_are_seen() -> None:
    def grey(value: float, rays: Rays) -> sampling.Picture:
        return sampling.Picture(torch.full((len(rays), 3), value), len(rays), 0)

    for value, kept in ((0.5, True), (0.45, True), (0.3, False), (float("nan"), False)):
        found = quadrature.changed("", "", 0.1, partial(grey, value), partial(grey, 0.5), 10, seed=0)
        assert found.kept is kept


def test_a_power_law_is_met_between_its_points() -> None:
    evaluations = [8.0, 16.0, 32.0, 64.0]
    errors = [3 * n**-2 for n in evaluations]
    assert evaluations_needed(evaluations, errors, 1e-3) == pytest.approx(3000**0.5)
    assert evaluations_needed(evaluations, errors, errors[2]) == pytest.approx(32)
    assert evaluations_needed(evaluations, errors, 1.0) == 8
    assert evaluations_needed(evaluations, errors, 1e-4) is None
    assert evaluations_needed([], [], 1.0) is None
    assert evaluations_needed([4.0, 8.0], [1.0, 0.0], 1e-3) == pytest.approx(4 * 2 ** (3 / 12))


def test_costs_are_by_scene_and_sampler() -> None:
    rows = [Row("fog", "proposal", n, n, 6 * n, 3 * n**-2.0, 0.0, 1.0) for n in (8, 16, 32, 64)]
    rows.append(Row("fog", "uniform", 8, 32, 0, 0.5, 0.0, 1.0))
    found = {(cost["sampler"], cost["mean_error"]): cost for cost in quadrature.costs(rows)}
    assert found["proposal", 1e-3]["evaluations"] == pytest.approx(3000**0.5)
    assert found["proposal", 1e-3]["in_all"] == pytest.approx(7 * 3000**0.5)
    assert found["uniform", 1e-2]["evaluations"] is None


def test_rays_are_those_of_their_seed() -> None:
    rays = random_rays(1000, seed=5)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(1000))
    nearest = rays.origins - (rays.origins * rays.directions).sum(-1, keepdim=True) * rays.directions
    assert nearest.norm(dim=-1).max().item() <= 1 + 1e-5
    torch.testing.assert_close(random_rays(1000, seed=5).origins, rays.origins, rtol=0, atol=0)
    assert not torch.equal(random_rays(1000, seed=6).origins, rays.origins)


@pytest.mark.medium
def test_all_of_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some = {name: scene for name, scene in scenes().items() if name in ("blobs", "sparse")}
    monkeypatch.setattr(quadrature, "scenes", lambda: some)
    monkeypatch.setattr(quadrature, "QUICK", TINY)
    monkeypatch.setattr("nerfloom.comparison.plots.available", lambda: False)
    content = quadrature.main(tmp_path / "out" / "quadrature.json", tmp_path / "plots", quick=True)
    assert json.loads((tmp_path / "out" / "quadrature.json").read_text()) == json.loads(json.dumps(content))
    assert len(content["rows"]) == 2 * 2 * 7
    assert {row["sampler"] for row in content["rows"]} == set(_names())
    assert len(content["skipping"]) == 2 * (1 + len(quadrature.THRESHOLDS))
    said = capsys.readouterr().err
    assert "pip install matplotlib" in said
    assert not (tmp_path / "plots").exists()


def _names() -> list[str]:
    return ["uniform", "stratified", "hierarchical", "proposal", "even steps", "occupancy", "early stop"]


def test_pictures(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    errors = [1e-1, 1e-2, 0.0]
    found = {"fog": {"proposal": Curve([8.0, 16.0, 32.0], [56.0, 112.0, 224.0], errors, [1e-3, 1e-3, 0.0])}}
    (path,) = error_curves.draw(found, tmp_path / "plots")
    assert path.stat().st_size > 1000


class Unsure(Field):
    """NaN everywhere."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return points.positions.new_full((len(points),), torch.nan), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features


def test_a_broken_field_is_seen() -> None:
    rays = random_rays(20, seed=7)
    row = measured("", "", 8, partial(sampled, Unsure(), UniformSampler(8), False), rays, torch.zeros(20, 3).double())
    assert math.isnan(row.mean_error)
