"""Parts of a method of Gaussians that a plugin replaces: columns, motion, strategy and rasteriser."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom import GaussianModel, View
from nerfloom.cameras.poses import Placement
from nerfloom.geometry.regions import Box
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.methods.gaussian_splatting import METHOD, GaussianSplatting
from nerfloom.registry import load_method
from nerfloom.splats.drawing import draw_colors, splat_camera
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians
from nerfloom.splats.rasteriser import Projected, Rasteriser
from nerfloom.splats.table import as_rows
from nerfloom.testing.method_under_test import Learner
from nerfloom.testing.scenes import RISE, moving_ball
from nerfloom.viewer.crop import picture_within
from nerfloom.viewer.request import Crop
from tests.interfaces.methods.drift import Drift
from tests.interfaces.methods.fittest import COPIED, DROPPED, Fittest
from tests.splats.test_files import exported, pretend
from tests.splats.test_method import SCENE, ball, camera

MOVING = dataclasses.replace(SCENE, moving=True)
FEW: dict[str, Any] = {"start": "random", "num_gaussians": 600, "start_gaussians": 400, "steps_per_move": 20}


def learner(name: str, seed: int = 0, **changes: Any) -> Learner:
    """A method on a ball that rises by 2 * RISE from time 0 to 1, seen from all around."""
    method = load_method(name)
    return Learner(method, dataclasses.replace(method.config, **FEW, **changes), moving_ball(), seed)


@pytest.mark.medium
def test_velocities_are_those_of_the_ball_and_make_pictures_sharper() -> None:
    """The mean velocity of visible Gaussians is compared with the path of the ball; the error, with still Gaussians.

    The velocity is the mean of two seeds, because 400 random places leave a chance of 0.03 in each coordinate.
    """
    moving, still = (
        [learner("drift", seed, rate_factor=8.0) for seed in (0, 1)],
        learner("gaussian-splatting", rate_factor=8.0),
    )
    for _ in range(200):
        for found in (*moving, still):
            found.step()
    velocity = torch.stack([mean_velocity(found.model) for found in moving]).mean(0)
    print(velocity, moving[0].error(), still.error())
    torch.testing.assert_close(velocity, torch.tensor([0.0, 0.0, 2 * RISE]), atol=0.2 * (2 * RISE), rtol=0)
    assert moving[0].error() < 0.2 * still.error()  # 7 dB


def mean_velocity(model: object) -> torch.Tensor:
    """The mean velocity (3,) of Gaussians, by what they cover."""
    assert isinstance(model, Drift)
    start, end = model.gaussians(0.0), model.gaussians(1.0)
    weights = torch.sigmoid(start.logits)[:, None] * start.log_scales.exp().mean(1, keepdim=True).square()
    return (weights * (end.means - start.means)).sum(0) / weights.sum()


def test_all_columns_go_through_growth_moves_and_checkpoints() -> None:
    """Each row keeps its values of all columns together, with any changes of other rows."""
    for strategy in ("adc", "mcmc", "relocation"):
        found = learner("drift", strategy=strategy, steps_per_reset=10**6)
        model: GaussianModel[Any] = found.model  # type: ignore[assignment]
        count = 400
        tagged = torch.arange(count).float()[:, None].expand(-1, 3).contiguous()
        first = ball(0.5, harmonics=torch.zeros(1, 3, 15))[torch.zeros(count, dtype=torch.long)]
        model.set_gaussians(dataclasses.replace(first, colors=tagged, extras={"velocities": tagged}))
        for name, column in model.columns.items():
            assert len(column.values) == count, name
        model.columns["logits"].values.data[::3] = -9.0  # are dropped, or moved
        for change in model.after_step(0, 0.0):
            found.optimizer.change_rows(change)
        grown = model.gaussians()
        assert len(grown) != count or not torch.equal(grown.colors, first.colors)
        torch.testing.assert_close(grown.extras["velocities"], grown.colors)
        other = learner("drift", strategy=strategy).model
        other.load_state_dict(model.state_dict())
        for name, values in model.gaussians().columns.items():
            assert torch.equal(other.gaussians().columns[name], values), name  # type: ignore[operator]


def test_a_column_that_nobody_declared_is_refused() -> None:
    model = METHOD.build(dataclasses.replace(METHOD.config, **FEW), SCENE)
    assert isinstance(model, GaussianSplatting)
    given = dataclasses.replace(ball(harmonics=torch.zeros(1, 3, 15)), extras={"weights": torch.ones(1)})
    with pytest.raises(ValueError, match="there is no column weights, only means, log_scales"):
        as_rows(model.columns, given)


def test_the_fittest_stay_and_are_copied() -> None:
    strategy, count = Fittest(), 100
    gaussians = ball(harmonics=torch.zeros(1, 3, 0))[torch.zeros(count, dtype=torch.long)]
    gaussians = dataclasses.replace(gaussians, logits=torch.arange(count).float(), means=torch.randn(count, 3))
    pulled = torch.arange(count).flip(0).float()  # the faintest are pulled at most
    strategy.gradients.sums = torch.stack([pulled, torch.ones(count)], 1)
    change = strategy.grow(gaussians, 1000, 1.0)
    assert change is not None
    faintest, copies = count // DROPPED, count // COPIED
    assert change.kept.tolist() == list(range(faintest, count))
    assert change.fresh.logits.tolist() == list(range(faintest, faintest + copies))
    limited = strategy.grow(gaussians, count - faintest + 3, 1.0)
    assert limited is not None
    assert len(limited.fresh) == 3


class Flat(Rasteriser):
    """Draws discs: Gaussians of no thickness."""

    def project(self, gaussians: Gaussians, camera: SplatCamera, degree: int = MAX_DEGREE) -> Projected:
        return super().project(flattened(gaussians), camera, degree)


def flattened(gaussians: Gaussians) -> Gaussians:
    thin = gaussians.log_scales.argmin(-1, keepdim=True)
    return dataclasses.replace(gaussians, log_scales=gaussians.log_scales.scatter(1, thin, -12.0))


class Discs(GaussianSplatting):
    rasteriser = Flat()


def test_another_projection_draws_every_picture() -> None:
    """These are pictures in training, in evaluation, and drawn repeatedly."""
    model = Discs(METHOD.decided(dataclasses.replace(METHOD.config, **FEW), SCENE)[0], SCENE)
    round_one = ball(log_scales=torch.full((1, 3), -1.5), harmonics=torch.zeros(1, 3, 15))
    turn = torch.tensor([[0.9, 0.4, 0.1, 0.0]])
    given = dataclasses.replace(round_one, rotations=turn, log_scales=torch.tensor([[-1.5, -1.4, -1.6]]))
    model.set_gaussians(given)
    view, black = View(camera()), torch.zeros(3)
    seen = splat_camera(view.camera, model.near, model.look())
    truth: Tensor = draw_colors(flattened(given), seen, 1, black)
    assert float((truth - draw_colors(given, seen, 1, black)).abs().max()) > 0.1
    for _ in range(3):
        torch.testing.assert_close(model.render_rgb(view, black), truth, atol=1e-6, rtol=0)
    torch.testing.assert_close(model.render_view(view, black).rgb, truth, atol=1e-6, rtol=0)
    trained = model.rasteriser.draw(model.on_image(model.learnt_gaussians(), seen, 3), seen, black)
    torch.testing.assert_close(trained.image, truth, atol=1e-6, rtol=0)


def test_a_moment_of_gaussians_that_move_is_drawn_again_only_at_that_time() -> None:
    model = drifting([1.0, 0.0, 0.0])
    black, found = torch.zeros(3), {}
    for time in (0.0, 0.0, 0.0, 1.0, 1.0, 0.5):
        image = model.render_rgb(View(camera(), time), black)
        torch.testing.assert_close(image, model.render_view(View(camera(), time), black).rgb, atol=1e-5, rtol=0)
        columns = torch.arange(image.shape[1]).float()
        found[time] = float((image.sum((0, 2)) * columns).sum() / image.sum())
    assert found[0.0] < found[0.5] - 5 < found[1.0] - 10  # 40 pixels at distance 3, and half a unit each way


def drifting(velocity: list[float]) -> Any:
    """One Gaussian at the origin at rest, which moves."""
    method = load_method("drift")
    model = method.build(dataclasses.replace(method.config, **FEW), MOVING)
    assert isinstance(model, Drift)
    extras = {"velocities": torch.tensor([velocity])}
    model.set_gaussians(dataclasses.replace(ball(harmonics=torch.zeros(1, 3, 15)), extras=extras))
    return model


@pytest.mark.parametrize(("flags", "expected"), [(("--time", "0.75"), 0.25), ((), -0.5)])
def test_a_moment_is_exported(
    flags: tuple[str, ...], expected: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Centres are where they are then: at time 0 if no other is given."""
    pretend(monkeypatch, drifting([1.0, 2.0, 4.0]), Placement.of(None, 1.0), "drift")
    for suffix in ("ply", "spz"):
        exported(monkeypatch, tmp_path, suffix, *flags)
        read = read_gaussians(tmp_path / f"splat.{suffix}").gaussians
        torch.testing.assert_close(read.means, expected * torch.tensor([[1.0, 2.0, 4.0]]), atol=1e-3, rtol=0)


def test_a_crop_box_holds_what_is_inside_at_its_time() -> None:
    model, black = drifting([2.0, 0.0, 0.0]), torch.zeros(3)
    right = Crop(Box((0.5, -0.5, -0.5), (1.5, 0.5, 0.5)))
    shown = [float(picture_within(model, View(camera(), time), right, black).rgb.max()) for time in (0.0, 1.0)]
    assert shown[0] == 0 < shown[1]
