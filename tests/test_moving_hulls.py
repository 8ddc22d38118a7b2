"""Silhouettes of moving bodies, at any speed: no matter is ever carved away, and most of the empty space is."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom.data.motion_bound import MotionBound
from nerfloom.geometry.points import Points
from nerfloom.registry import load_method
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.scene.moving_hulls import moving_box, moving_hulls
from nerfloom.scene.silhouettes import Silhouettes
from nerfloom.scene.speed import motion_bound
from nerfloom.training.preparation import decided, skip_by_silhouettes
from nerfloom.training.trainer import Trainer
from tests.moving_bodies import BOX, Motion, jump, lost, photographed, swinging_limb, thrown_ball
from tests.training.helpers import chosen, tiny_run

MOTIONS = {"ball": thrown_ball, "limb": swinging_limb, "jump": jump}
SLICES, CELLS = 10, 32


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.25, 0.5, 1.5, 3.0, 6.0])
@pytest.mark.parametrize("name", list(MOTIONS))
def test_nothing_that_moves_is_carved_away_at_any_speed(name: str, speed: float) -> None:
    """The found speed and the remaining part of the box are right too: nearly nothing for slow motion."""
    check(MOTIONS[name], speed, 100, most_left={0.25: 0.04, 0.5: 0.06, 1.5: 0.2}.get(speed, 0.7))


@pytest.mark.medium
def test_a_swinging_limb_is_not_carved_away() -> None:
    check(swinging_limb, 3.0, 60, most_left=0.6)


def check(moving: Callable[[float], Motion], speed: float, count: int, most_left: float) -> None:
    """No moving matter is lost, and at most `most_left` of the box is left, with `count` images."""
    dataset, times = photographed(moving(speed), count)
    silhouettes = Silhouettes.of(dataset)
    bound = motion_bound(silhouettes, BOX, times)
    assert bound is not None
    box = moving_box(silhouettes, BOX, times, bound)
    hulls = moving_hulls(silhouettes, box, CELLS, times, bound, SLICES).view(SLICES, CELLS, CELLS, CELLS)
    left = float(hulls.double().mean()) * float(((box[1] - box[0]) / 3).prod())
    found, worst = bound.fastest / 3, lost(hulls, box, moving(speed))
    print(f"{speed:g} edges: found {found:.2f}, at the worst moment {worst:.2%} lost, {left:.1%} left")
    assert worst == 0
    assert left < most_left
    assert found > 0.9 * speed or found > 2
    assert found < 3 * max(speed, 0.25)


def test_distances_add_up_speeds_and_the_larger_of_two_counts() -> None:
    bound = MotionBound.of(torch.tensor([0.2, 0.4, 0.8]), torch.tensor([1.0, 3.0, 2.0]))
    times = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 0.9, 1.0])
    expected = [0.0, 0.1, 0.2, 0.5, 0.8, 1.4, 2.0, 2.2, 2.4]
    torch.testing.assert_close(bound.at(times), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-6)
    assert bound.fastest == pytest.approx(3.0)
    whole = MotionBound.of(torch.tensor([0.0, 1.0]), torch.tensor([1.0, 2.0]))
    assert whole.fastest == pytest.approx(2.0)
    assert float(whole.at(torch.tensor([0.5]))) == pytest.approx(1.0)


@pytest.mark.medium
def test_speeds_are_those_about_each_time() -> None:
    """A ball rests but for a tenth of the time: only about that time it is fast."""
    dataset, times = photographed(thrown_ball(6.0), 100)
    bound = motion_bound(Silhouettes.of(dataset), BOX, times)
    assert bound is not None
    speeds = bound.at(times).diff() / times.diff() / 3
    flying = (times[1:] > 0.42) & (times[:-1] < 0.49)
    print(f"in flight {float(speeds[flying].min()):.2f} to {float(speeds[flying].max()):.2f}")
    assert float(speeds[flying].max()) > 5
    assert float(speeds[(times[1:] < 0.25) | (times[:-1] > 0.65)].max()) < 0.8


@pytest.mark.medium
def test_an_opaque_pixel_that_no_motion_explains_is_given_up(tmp_path: Path) -> None:
    """A speck in one of several images of one time, which the others of that time do not show."""
    dataset, times = photographed(swinging_limb(0.25), 40)
    pixels = dataset.pixels.clone()
    pixels[20 * 100 * 100 + 1500, 3] = 255
    twice = times.clone()
    twice[1::2] = times[::2]
    bound = motion_bound(Silhouettes.of(replace(dataset, pixels=pixels)), BOX, twice)
    assert bound is not None
    assert torch.isfinite(bound.distances).all()


@pytest.mark.medium
@pytest.mark.parametrize("count", [20, 40])
def test_of_too_few_images_no_speed_is_found_and_nothing_carved(count: int, tmp_path: Path) -> None:
    dataset, times = photographed(swinging_limb(0.5), count, size=40)
    run = tiny_run("kplanes", tmp_path, tmp_path, max_num_iterations=1, max_eval_images=0)
    trainer = Trainer.of(run, dataset)
    drawn = skip_by_silhouettes(trainer.config, trainer.model, trainer.train_set, fresh=True).drawn
    assert drawn is None  # a pixel that is empty at its time shows matter at others
    said, sampler = chosen(trainer), trainer.model.sampler
    reason = {decision.option: decision.reason for decision in trainer.profile.decisions}["silhouettes"]
    if count == 20:
        assert said["silhouettes"] == "not used"
        assert "20 images at 20 times" in reason
        assert "motion" not in said
        assert not bool(sampler.carved.any())
        assert torch.equal(trainer.train_set.scene.box, BOX)
    else:
        assert said["motion"].startswith("at most 0.")
        assert said["silhouettes"].startswith("what is outside all of them")
        assert not torch.equal(trainer.train_set.scene.box, BOX)
        silhouettes, bound = Silhouettes.of(trainer.train_set), trainer.train_set.motion_bound
        assert bound is not None
        hull = moving_hulls(silhouettes, sampler.box, sampler.resolution, times, bound, sampler.slices)
        assert torch.equal(sampler.carved, ~hull)
        assert 0.1 < float(hull.double().mean()) < 0.9


@pytest.mark.medium
def test_a_method_of_still_scenes_takes_the_speed_too() -> None:
    """It keeps the data's box, and cells that are occupied at any time."""
    dataset, _ = photographed(thrown_ball(1.5), 40, size=40)
    found, _, made = decided(instant_ngp := load_method("instant-ngp"), instant_ngp.config, dataset)
    assert found.motion_bound is not None
    assert torch.equal(found.scene.box, BOX)
    assert made[0].option == "motion"


@pytest.mark.medium
def test_the_grid_forgets_less_of_what_crosses_many_cells_of_a_slice() -> None:
    """A limb moves at 6 box edges, with an exactly known density; without more looks half as much again is skipped."""
    motion, moments, found = swinging_limb(6.0), 2001, []
    hands = torch.tensor([motion(time)[0][1] for time in torch.linspace(0, 1, moments).tolist()])
    shoulder = torch.tensor([0.0, 0.0, 0.5])

    def density(points: Points) -> tuple[torch.Tensor, None]:
        assert points.times is not None
        axis = hands[(points.times * (moments - 1)).round().long()] - shoulder
        share = ((points.positions - shoulder) * axis).sum(-1, keepdim=True) / axis.square().sum(-1, keepdim=True)
        apart = (points.positions - shoulder - share.clamp(0, 1) * axis).norm(dim=-1)
        return torch.where(apart < 0.08, 60.0, 0.0), None

    for distance in (0.0, 3 * 6.0 / SLICES):
        torch.manual_seed(0)
        sampler = OccupancySampler(BOX, CELLS, num_steps=128, moving=True, slices=SLICES)
        sampler.expect_motion(distance)
        for step in range(1, 1001):
            sampler.update(step, density)
        cells = sampler.occupied.view(SLICES, CELLS, CELLS, CELLS)
        found.append(lost(cells, BOX, motion, moments=41))
    print("skipped at the worst moment: " + ", ".join(f"{share:.1%}" for share in found))
    assert found[1] < found[0] / 1.5
