"""Training through ruinous conditions: no density, no samples, infinite gradients, NaN pictures, long runs."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import ConfigError
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import Field
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.adam.adam import sparse_adam
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.uniform import UniformSampler
from nerfloom.training.optim import Adam
from nerfloom.training.state import State
from nerfloom.training.trainer import Trainer
from tests.stress.backends import backends
from tests.training.helpers import assert_same_bits, tensors, tiny_trainer

BETAS = (0.9, 0.99)
EPSILONS = [1e-7, 1e-8, 1e-12, 1e-15]
"""Epsilons that methods use."""


# -- Adam ---------------------------------------------------------------------------------------------------------


@pytest.mark.entry(2)
@pytest.mark.parametrize("kind", ["instant-ngp", "vanilla-nerf"])
def test_weights_and_moments_are_float32_under_mixed_precision(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    """Half precision would round an epsilon of 1e-8, and most changes of a step, to 0."""
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run", mixed_precision=True)
    trainer.train_step()
    kept = [*trainer.model.parameters()]
    for state in trainer.optimizer.state.values():
        kept += [value for value in state.values() if isinstance(value, Tensor)]
    assert {value.dtype for value in kept} == {torch.float32}
    assert all(torch.tensor(group["eps"], dtype=torch.float32) > 0 for group in trainer.optimizer.param_groups)
    assert trainer.state.skipped == 0


@pytest.mark.entry(2)
@pytest.mark.parametrize("eps", [0.0, 1e-50])
def test_an_epsilon_of_which_float32_leaves_nothing_is_refused(eps: float) -> None:
    with pytest.raises(ConfigError, match="--adam-eps"):
        TrainConfig(adam_eps=eps)


def first_step(sparse: bool, gradients: Tensor, eps: float, rate: float) -> Tensor:
    """Where parameters that are 0 stand after one step of Adam with the given gradients (N, 2)."""
    parameter = nn.Parameter(torch.zeros_like(gradients))
    if sparse:
        state = [torch.zeros_like(gradients), torch.zeros_like(gradients), torch.zeros(len(gradients))]
        with torch.no_grad():
            sparse_adam(parameter, gradients.clone(), *state, rate, BETAS, eps)
    else:
        parameter.grad = gradients.clone()
        Adam([{"params": [parameter]}], {}, rate, BETAS, eps).step()
    return parameter.detach()


@pytest.mark.entry(2)
@backends()
@pytest.mark.parametrize("sparse", [True, False])
@pytest.mark.parametrize("eps", EPSILONS)
def test_gradients_of_any_size_take_a_step_of_the_learning_rate_at_most(backend: str, sparse: bool, eps: float) -> None:
    """-rate g / (|g| + eps), also where g^2 is 0 in float32; without a gradient nothing moves."""
    sizes = torch.tensor([0.0, 1e-30, 1e-20, 1e-12, 1e-8, 1e-4, 1.0, 1e4, 1e10, 1e18])
    gradients = torch.stack([sizes, -sizes], dim=-1)
    found = first_step(sparse, gradients, eps, rate=0.125)
    exact = gradients.double()
    expected = -0.125 * exact / (exact.abs() + eps)
    torch.testing.assert_close(found.double(), expected, rtol=2e-3, atol=1e-37)
    assert not found[0].any()


@pytest.mark.entry(3)
@backends()
@pytest.mark.parametrize("seen", [0.0, 1e5, 2.0**24])
def test_a_long_run_of_equal_gradients_takes_equal_steps(backend: str, seen: float) -> None:
    """The moments do not drift, and counts that float32 can no longer raise are harmless."""
    values, rate, steps, g = torch.zeros(64, 2), 2.0**-10, 400, 0.3
    start = g if seen else 0.0
    mean, square = torch.full_like(values, start), torch.full_like(values, start * start)
    counts = torch.full((64,), seen)
    for _ in range(steps):
        sparse_adam(values, torch.full_like(values, g), mean, square, counts, rate, BETAS, 1e-15)
    torch.testing.assert_close(values, torch.full_like(values, -rate * steps), rtol=1e-3, atol=0)
    torch.testing.assert_close(mean, torch.full_like(values, g), rtol=1e-3, atol=0)


@pytest.mark.entry(3)
def test_counts_and_means_after_a_hundred_thousand_steps() -> None:
    run = SimpleNamespace(
        state=State(),
        model=SimpleNamespace(read_counts=lambda: None),
        _unread=[],
        _count_bad=lambda step, finite: None,
    )
    error = torch.tensor([0.01, 1, math.nan], dtype=torch.float64)  # finite, and its samples are known
    for done in range(1, 100_001):
        run.state.account(4097, 3, 1e-3)
        run._unread.append(error)
        if done % 1000 == 0:
            Trainer._read_errors(run, done)  # type: ignore[arg-type]
    state = run.state
    assert state.step == 100_000
    assert state.rays == 409_700_000
    assert state.seconds == pytest.approx(100, rel=1e-9)
    assert state.samples_per_ray == pytest.approx(3, rel=1e-9)
    assert state.train_mse == pytest.approx(0.01, rel=1e-9)


# -- steps that are not finite ------------------------------------------------------------------------------------


@pytest.mark.entry(6)
@backends()
def test_a_step_with_an_infinite_gradient_is_dropped(backend: str, shared_tiny: Path, tmp_path: Path) -> None:
    """There is no gradient scaler, so its checks cannot be skipped: the step itself checks."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    trainer.train_step()
    weight = trainer.model.field.density_head[0].weight
    before = tensors(trainer)
    handle = weight.register_hook(lambda grad: torch.full_like(grad, math.inf))
    trainer.train_step()
    handle.remove()
    assert trainer.state.skipped == 1
    assert_same_bits(before, tensors(trainer))
    kept = weight.detach().clone()
    trainer.train_step()
    assert trainer.state.skipped == 1
    assert not torch.equal(weight, kept)


@pytest.mark.entry(6)
@backends()
@pytest.mark.parametrize("factor", [1.0, 0.0, math.inf, -math.inf, math.nan])
def test_an_infinite_gradient_that_waits_for_the_optimiser_is_found(backend: str, factor: float) -> None:
    """A table's gradient is not added up before the step; its parts are checked."""
    grid = HashGrid(2, 2, 4, 8, 8, sparse=True)
    assert grid.deferred is not None
    optimizer = Adam([{"params": [grid.table], "sparse": True}], {grid.table: grid.deferred}, 1e-2, BETAS, 1e-15)
    (grid(torch.rand(9, 3)) * factor).sum().backward()
    bad = optimizer.first_bad()
    assert (bad is None) == math.isfinite(factor)
    assert bad is None or bad is grid.table


@pytest.mark.entry(3)
def test_one_nan_picture_does_not_spoil_the_running_mean(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    render = trainer.model.render

    def broken(rays: Rays, background: Tensor) -> Rendered:
        found = render(rays, background)
        return dataclasses.replace(found, rgb=found.rgb * math.nan)

    trainer.model.render, trainer.model.plain = broken, False
    trainer.train_step()
    trainer.model.render = render
    for _ in range(3):
        report = trainer.train_step()
    assert trainer.state.skipped == 1
    assert math.isfinite(report.psnr)


# -- nothing to see -----------------------------------------------------------------------------------------------


@pytest.mark.entry(4)
@backends()
@pytest.mark.parametrize("kind", ["tensorf", "kplanes"])
def test_a_batch_without_samples_is_harmless(backend: str, kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    """Every ray empty: the step counts, nothing becomes NaN, and pictures show the background."""
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run")
    model = trainer.model
    model.sampler.occupied.zero_()
    model.sampler.forget()
    report = trainer.train_step()
    assert trainer.state.skipped == 0
    assert math.isfinite(sum(report.losses.values()))
    assert all(bool(parameter.isfinite().all()) for parameter in model.parameters())
    cameras, background = trainer.train_set.cameras, torch.tensor([0.1, 0.2, 0.3])
    rays = cameras.pixel_rays(cameras.image_pixels(0), 0.0, 10.0)
    out = model.render(rays, background)
    assert out.num_samples == 0
    torch.testing.assert_close(out.rgb, background.expand(len(rays), 3))


@pytest.mark.entry(4)
@pytest.mark.parametrize("kind", ["vanilla-nerf", "nerfacto", "dnerf"])
def test_no_rays_make_an_empty_picture(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run")
    cameras = trainer.train_set.cameras
    none = cameras.pixel_rays(cameras.image_pixels(0)[:0], 2.0, 6.0, trainer.train_set.times)
    for training in (True, False):
        out = trainer.model.train(training).render(none, torch.ones(3))
        shapes = [tuple(values.shape) for values in (out.rgb, out.depth, out.median_depth, out.accumulation)]
        assert shapes == [(0, 3), (0,), (0,), (0,)]


def looking_inwards(count: int) -> Rays:
    """Rays from a sphere of radius 3 to near the origin."""
    origins = 3 * nn.functional.normalize(torch.randn(count, 3), dim=-1)
    directions = nn.functional.normalize(torch.rand(count, 3) - 0.5 - origins, dim=-1)
    return Rays(origins, directions, torch.full((count,), 1.5), torch.full((count,), 4.5))


def fresh_field(kind: str) -> tuple[Field, nn.Parameter]:
    """A small field, and the weights that make its density."""
    if kind == "nerf":
        nerf = NeRFField(32, 3, skip=2)
        return nerf, nerf.sigma_head[0].weight
    box = torch.tensor([[-1.5] * 3, [1.5] * 3])
    encoded = EncodedField(box, HashGrid(4, 2, 8, 32, 10), width=32)
    return encoded, encoded.density_head[-1].weight


@pytest.mark.medium
@pytest.mark.entry(7)
@backends()
@pytest.mark.parametrize("photographs", [1.0, 0.0])
@pytest.mark.parametrize("kind", ["nerf", "hash grid"])
def test_density_wakes_up_for_plain_photographs(backend: str, kind: str, photographs: float) -> None:
    """White or black, over black: there is a gradient at once, and the error goes."""
    torch.manual_seed(1)
    field, weight = fresh_field(kind)
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-2)
    errors = []
    for _ in range(60):
        rays = looking_inwards(64)
        samples = UniformSampler(16).sample(rays, field, True)
        out = VolumeRenderer().render(rays, samples, field, torch.zeros(3))
        loss = (out.rgb - photographs).square().mean()
        optimizer.zero_grad()
        loss.backward()
        if not errors:
            assert weight.grad is not None
            assert bool(weight.grad.isfinite().all())
            assert bool(weight.grad.any())
        optimizer.step()
        errors.append(loss.item())
    print(f"{backend} {kind}, photographs of {photographs:g}: error {errors[0]:.3f} -> {errors[-1]:.5f}")
    assert errors[-1] < errors[0] / 4


def plain(folder: Path, pixel: list[int]) -> Path:
    """All photographs of a data set, replaced by a plain colour."""
    for file in folder.rglob("*.png"):
        shape = iio.imread(file).shape[:2]
        iio.imwrite(file, np.full((*shape, len(pixel)), pixel, np.uint8))
    return folder


@pytest.mark.medium
@pytest.mark.entry(7)
@pytest.mark.parametrize("pixel", [[255] * 3, [0] * 3, [0] * 4], ids=["white", "black", "transparent"])
def test_training_on_plain_photographs(pixel: list[int], tiny: Path, tmp_path: Path) -> None:
    """Silhouettes that leave nothing are not used; no step is dropped, and the error goes."""
    data = plain(tiny, pixel)
    trainer = tiny_trainer("instant-ngp", data, tmp_path / "run", mixed_precision=False, max_num_iterations=60)
    errors = [trainer.train_step().losses["rgb"] for _ in range(60)]
    print(f"photographs of {pixel}: error {errors[0]:.3f} -> {errors[-1]:.5f}")
    assert trainer.state.skipped == 0
    assert errors[-1] < errors[0] / 2


# -- training and evaluation alike --------------------------------------------------------------------------------


@pytest.mark.entry(14)
def test_rays_begin_and_end_alike_in_training_and_evaluation(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path / "run", evaluated=True)
    assert trainer.eval_set is not None
    seen: list[tuple[bool, set[float], set[float]]] = []
    render, scene = trainer.model.render, trainer.model.scene

    def spy(rays: Rays, background: Tensor) -> Rendered:
        seen.append((trainer.model.training, set(rays.nears.tolist()), set(rays.fars.tolist())))
        return render(rays, background)

    trainer.model.render, trainer.model.plain = spy, False
    trainer.train_step()
    trainer.model.render_view(trainer.eval_set.view(0), trainer.model.background)
    assert {training for training, _, _ in seen} == {True, False}
    assert {(*nears, *fars) for _, nears, fars in seen} == {(scene.near, scene.far)}


@pytest.mark.entry(23)
@backends()
@pytest.mark.parametrize("kind", ["instant-ngp", "nerfacto"])
def test_a_depth_map_does_not_depend_on_the_chunks(backend: str, kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    """Half of the light may be gone on either side of a sample's end, by rounding: a pixel in a hundred may differ."""
    settings: dict[str, Any] = {"mixed_precision": False, "rays_per_pixel": 1}
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run", evaluated=True, **settings)
    assert trainer.eval_set is not None
    for _ in range(3):
        trainer.train_step()
    views = []
    for chunk in (57, 8192):
        trainer.model.config = dataclasses.replace(trainer.model.config, eval_num_rays_per_chunk=chunk)
        views.append(trainer.model.render_view(trainer.eval_set.view(0), trainer.model.background))
    apart = (views[0].median_depth - views[1].median_depth).abs()
    assert views[0].median_depth.unique().numel() > 1
    assert (apart > 1e-3).float().mean().item() <= 0.01
    torch.testing.assert_close(views[0].accumulation, views[1].accumulation, rtol=0, atol=1e-4)
