"""Voxels: a cube from photographs, one leaf's colour, and changes of leaves, which keep the picture."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import CheckpointError, ConfigError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.poses import Placement
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import PixelBatch, composite
from nerfloom.export.bake import Baking, bake
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.encodings.spherical_harmonics import CONSTANT
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import error_bound
from nerfloom.kernels.octree.trace import trace_octree
from nerfloom.kernels.octree.walk import leaf_at
from nerfloom.kernels.octree.weights import raise_weights
from nerfloom.losses.leaf_variation import SMOOTH, leaf_variation
from nerfloom.methods.voxels import METHOD, Voxels
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.grid import Grid
from nerfloom.octrees.growth import UNMET, moments, split, visible
from nerfloom.octrees.hull import Hull, overlapped
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.loaded import Loaded
from nerfloom.training.optim import Adam, make_optimizer
from nerfloom.training.step import train_step
from nerfloom.training.trained import restore_model
from nerfloom.training.trainer import Trainer
from tests.training.helpers import TINY

CUBE = torch.tensor([[-0.5] * 3, [0.5] * 3])
FACES = torch.tensor(
    [[0.9, 0.2, 0.1], [0.2, 0.8, 0.2], [0.1, 0.3, 0.9], [0.9, 0.8, 0.1], [0.8, 0.2, 0.8], [0.1, 0.8, 0.8]]
)
SCENE = ball_in_a_box().scene
NONE = torch.zeros(0, 3, dtype=torch.int64)


def built(**settings: Any) -> Voxels:
    torch.manual_seed(0)
    model = METHOD.build(replace(METHOD.config, **{**TINY["voxels"], **settings}), SCENE)
    assert isinstance(model, Voxels)
    return model


def filled(degree: int = 1, **settings: Any) -> Voxels:
    """A model of 8^3 leaves, some dense and some not, with colours in [0, 1]."""
    model = built(resolution=16, degree=degree, **settings)
    coefficients = torch.zeros(512, 3, (degree + 1) ** 2)
    coefficients[..., 0] = (0.2 + 0.6 * torch.rand(512, 3)) / CONSTANT
    coefficients[..., 1:] = 0.1 * torch.randn(512, 3, (degree + 1) ** 2 - 1)
    model.set_octree(model.layout, 2 * torch.randn(512, 1), coefficients.flatten(1))
    return model.eval()


def some_rays() -> Rays:
    cameras = ball_in_a_box().cameras
    return cameras.pixel_rays(torch.arange(0, int(cameras.offsets[-1]), 5), 0.0, 6.0)


def colors(model: Voxels, rays: Rays) -> Tensor:
    with torch.no_grad():
        return model.light(rays, torch.ones(3), 0.0).color


def change(model: Voxels, number: int) -> Adam:
    """Make the change of a number, from 0, as a training step does; return the optimiser."""
    model.changes.fill_(number)
    optimizer = make_optimizer(model, model.config)
    for state in optimizer.state.values():
        state["exp_avg"].fill_(1.0)
    progress = moments(model.config.num_splits)[number][0]
    assert model.changes_rows(0, progress)
    assert not model.changes_rows(0, progress - 1e-6)
    for rows in model.after_step(0, progress):
        optimizer.change_rows(rows)
    assert int(model.changes) == number + 1
    return optimizer


# -- a cube, and one leaf -------------------------------------------------------------------------------------------


def cube() -> Dataset:
    """Images of a cube with a colour for each face, transparent around it."""
    dataset = ball_in_a_box()
    rays = dataset.cameras.pixel_rays(torch.arange(len(dataset.pixels)), 0.0, 6.0)
    enter, leave = intersect_box(rays.origins, rays.directions, CUBE)
    places = rays.origins + enter[:, None] * rays.directions
    axis = places.abs().argmax(-1)
    side = places.gather(1, axis[:, None])[:, 0] > 0
    rgba = torch.cat([FACES[axis + 3 * side], (leave > enter)[:, None].float()], -1)
    return replace(dataset, pixels=(255 * rgba).round().to(torch.uint8))


@pytest.mark.medium
def test_a_cube() -> None:
    """Its silhouettes cut away most of the box and nothing of the cube; its faces are learnt from eight images."""
    dataset = cube()
    trainer = Trainer(METHOD, replace(METHOD.config, **TINY["voxels"], vis="none", max_num_iterations=250), dataset)
    trainer.prepare()
    model = trainer.model
    assert isinstance(model, Voxels)
    first = model.layout
    inside = 0.499 * (2 * torch.rand(2000, 3) - 1)
    assert bool((leaf_at(first, inside) >= 0).all())
    assert first.num_leaves < 16**3 / 2
    assert list(trainer.steps())
    model.eval()
    assert int(model.changes) == 3
    assert model.layout.cell == pytest.approx(first.cell / 2)
    assert 0 < model.layout.num_leaves < 8 * first.num_leaves
    errors, opacities = [], []
    for index in range(len(dataset)):
        truth, shown = dataset.image(index).float() / 255, model.render_view(dataset.view(index), torch.ones(3))
        errors.append(float((shown.rgb - composite(truth, torch.ones(3))).square().mean()))
        opacities.append(float((shown.accumulation - truth[..., 3]).abs().mean()))
    print(f"errors {max(errors):.2g}, opacities {max(opacities):.2g}")
    assert max(errors) < 0.015
    assert max(opacities) < 0.06
    away = torch.tensor([[0.95, 0.95, 0.95], [-0.95, 0.0, 0.95], [7.0, 0.0, 0.0]])
    assert not model.density(Points(away)).any()


def test_one_leaf_has_the_light_of_its_depth_and_learns_its_colour() -> None:
    model = built(degree=0, num_splits=0, resolution=8)
    layout, _ = OctreeLayout.build(torch.full((3,), -0.5), 1.0, (1, 1, 1), NONE.new_zeros(1, 3))
    model.set_octree(layout, torch.zeros(1, 1), torch.full((1, 3), 0.5 / CONSTANT))
    places, target = 0.8 * torch.rand(64, 2) - 0.4, torch.tensor([0.8, 0.3, 0.2])
    rays = Rays(torch.cat([places, torch.full((64, 1), 3.0)], -1), torch.tensor([0.0, 0.0, -1.0]).repeat(64, 1))
    opacity = 1 - math.exp(-math.exp(-1))  # the depth of a raw density of 0 is exp(-1), along an edge
    behind = torch.rand(64, 3)
    found = model.eval().render(rays, behind)
    torch.testing.assert_close(found.accumulation, torch.full((64,), opacity))
    torch.testing.assert_close(found.rgb, opacity * 0.5 + (1 - opacity) * behind)
    assert found.extras["leaves"].tolist() == [1.0] * 64
    optimizer = make_optimizer(model, model.config)
    for step in range(150):
        batch = PixelBatch(torch.arange(64), rays, target.repeat(64, 1), torch.rand(64, 3), torch.ones(64))
        train_step(model, optimizer, batch, step, step / 150)
    # For any depth, the best colour gives the target over the mean of the backgrounds.
    shown = model.eval().render(rays, torch.full((3,), 0.5)).rgb[0]
    print(f"{shown.tolist()}, depth {float(model.depths()[0]):.3g}")
    torch.testing.assert_close(shown, target, atol=0.05, rtol=0)
    assert float(model.depths()[0]) > 1.0


# -- changes of leaves ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_splits", [0, 1, 3])
def test_each_size_of_leaves_lasts_twice_as_long_as_the_one_before(num_splits: int) -> None:
    found = moments(num_splits)
    splits = [0.0, *(share for share, is_split in found if is_split), 1.0]
    lengths = [end - begin for begin, end in pairwise(splits)]
    assert lengths == pytest.approx([2**level * lengths[0] for level in range(num_splits + 1)])
    middles = [share for share, is_split in found if not is_split]
    assert middles == pytest.approx([(begin + end) / 2 for begin, end in pairwise(splits)])
    assert [share for share, _ in found] == sorted(share for share, _ in found)


def test_what_stays() -> None:
    peaks = torch.tensor([0.3, 0.0, 0.1, 0.9, 0.2])
    assert visible(peaks, 0.1, 9).tolist() == [0, 2, 3, 4]
    assert visible(peaks, 0.1, 2).tolist() == [0, 3]
    assert visible(peaks, 0.95, 9).tolist() == [0, 1, 2, 3, 4]  # nothing is known yet
    assert visible(peaks[:0], 0.1, 9).tolist() == []
    peaks = torch.tensor([0.3, UNMET, 0.1, 0.0])
    assert visible(peaks, 0.1, 9).tolist() == [0, 1, 2]
    assert visible(peaks, 0.1, 2).tolist() == [0, 2]
    assert visible(peaks[1::2], 0.1, 9).tolist() == [0, 1]


def test_leaves_are_eighths_of_cells() -> None:
    torch.manual_seed(0)
    cells = torch.randint(24, (40, 3)).unique(dim=0)
    layout, _ = OctreeLayout.build(torch.zeros(3), 0.5, (3, 3, 3), cells)
    finer, wholes = split(layout, cells)
    assert finer.num_leaves == 8 * len(cells)
    torch.testing.assert_close(finer.box, layout.box)
    assert torch.equal(finer.cells() // 2, cells[wholes])
    assert torch.equal(wholes.bincount(), torch.full((len(cells),), 8))


@pytest.mark.parametrize("degree", [0, 1])
def test_a_split_keeps_the_picture(degree: int) -> None:
    model, rays = filled(degree), some_rays()
    model.peaks = torch.ones(512)
    before, layout = colors(model, rays), model.layout
    optimizer = change(model, 1)
    torch.testing.assert_close(colors(model, rays), before, atol=1e-5, rtol=0)
    assert model.layout.num_leaves == 8 * 512
    assert model.layout.cell == pytest.approx(layout.cell / 2)
    assert model.peaks.shape == (8 * 512,)
    assert bool((model.peaks == UNMET).all())
    assert all(not state["exp_avg"].any() and len(state["exp_avg"]) == 8 * 512 for state in optimizer.state.values())


def test_dropped_leaves_change_a_ray_by_their_weights_at_most() -> None:
    model, rays = filled(0, prune_weight=0.15), some_rays()
    model.peaks = torch.zeros(512)
    raw = model.densities.table.detach()
    raise_weights(model.layout, raw, rays, model.peaks)
    dropped = (model.peaks < 0.15).float()
    assert 20 < int(dropped.sum()) < 480
    shares = (dropped / CONSTANT)[:, None].repeat(1, 3)
    bound = trace_octree(model.layout, raw, shares, rays, torch.zeros(3)).color[:, 0]
    before = colors(model, rays)
    optimizer = change(model, 2)
    assert model.layout.num_leaves == 512 - int(dropped.sum())
    differences = (colors(model, rays) - before).abs().amax(-1)
    assert float(differences.max()) > 0.01
    assert bool((differences <= bound + 1e-5).all())
    assert all(bool(state["exp_avg"].all()) for state in optimizer.state.values())  # kept leaves go on


def test_leaves_that_no_ray_has_met_stay_once() -> None:
    """Three leaves: one behind an opaque one, one that all rays pass by, and the opaque one."""
    model = built(degree=0)
    cells = torch.tensor([[0, 0, 3], [5, 5, 3], [0, 0, 7]])
    layout, order = OctreeLayout.build(torch.full((3,), -0.5), 0.125, (1, 1, 1), cells)
    assert order.tolist() == [0, 1, 2]
    model.set_octree(layout, torch.tensor([[1.0], [1.0], [20.0]]), torch.full((3, 3), 0.5 / CONSTANT))
    places = 0.1 * torch.rand(64, 2) - 0.49
    rays = Rays(torch.cat([places, torch.full((64, 1), 3.0)], -1), torch.tensor([0.0, 0.0, -1.0]).repeat(64, 1))
    batch = PixelBatch(torch.arange(64), rays, torch.rand(64, 3), torch.rand(64, 3), torch.ones(64))
    assert model.peaks.tolist() == [UNMET] * 3
    train_step(model, make_optimizer(model, model.config), batch, 1, 0.1)
    change(model, 0)
    assert model.layout.cells().tolist() == [[5, 5, 3], [0, 0, 7]]
    assert model.peaks.tolist() == [0, UNMET]
    train_step(model, make_optimizer(model, model.config), batch, 1, 0.1)
    change(model, 1)
    assert (model.layout.cells() // 2).tolist() == [[0, 0, 7]] * 8
    assert model.peaks.tolist() == [UNMET] * 8


def test_pictures_bound_their_errors_once_and_by_the_newest_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    model, asked = filled(1).eval(), list[int]()
    monkeypatch.setattr("nerfloom.octree_model.error_bound", lambda *given: asked.append(1) or error_bound(*given))
    first = model.largest
    with model.rendering():
        assert model.largest == first == max(error_bound(model.coefficients(), 1.0), 1.0) > 1
    assert len(asked) == 1
    model.train()
    assert model.largest == 1
    model.colors.table.data *= 3
    assert model.eval().largest == error_bound(model.coefficients(), 1.0) > first
    model.load_state_dict({**model.state_dict(), "colors.table": 2 * model.coefficients()})
    assert model.largest == error_bound(model.coefficients(), 1.0)
    model.set_octree(model.layout, model.densities.table.data, 2 * model.coefficients())
    assert model.largest == error_bound(model.coefficients(), 1.0)
    assert len(asked) == 4


def test_no_more_leaves_than_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    model = filled(max_leaves=1024)
    model.peaks = torch.linspace(0.5, 1, 512)
    change(model, 1)
    assert model.layout.num_leaves == 1024
    assert "384 visible leaves are dropped, since --max-leaves is 1,024" in capsys.readouterr().err


def test_cells_that_overlap_others() -> None:
    torch.manual_seed(1)
    box = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 2.0, 1.0]])
    inside = torch.rand(6, 6, 6) < 0.05
    grid = Grid(torch.tensor([-1.2, -1.7, 0.05]), 0.23, (1, 2, 1))
    found, cell = overlapped(inside, box, grid), grid.cell
    edges = (box[1] - box[0]) / 6
    low = grid.positions(torch.cartesian_prod(*[torch.arange(count) for count in found.shape]))
    truth = torch.zeros(len(low), dtype=torch.bool)
    for place in inside.nonzero():
        begin = box[0] + place * edges
        truth |= ((low < begin + edges - 1e-4) & (low + cell > begin + 1e-4)).all(-1)
    assert 0 < int(truth.sum()) < len(truth)
    assert torch.equal(found.view(-1), truth)


def test_the_first_leaves_are_in_the_smallest_box_around_the_hull() -> None:
    hull = Hull(torch.tensor([[-1.0, -2.0, 0.0], [1.0, 2.0, 1.0]]), 8)
    kept = torch.zeros(8, 8, 8, dtype=torch.bool)
    kept[2:4, 1:7, 5] = kept[4, 6, 4] = True
    hull.carve(kept.view(-1))
    layout = hull.leaves(12)
    assert layout.origin.tolist() == [-0.5, -1.5, 0.5]
    assert layout.cell == 3 / 12  # from y = -1.5 to 1.5
    assert layout.size == (1, 2, 1)
    truth = [[x, y, 0] for x in (0, 1) for y in range(12)] + [[2, 10, 0], [2, 11, 0]]
    assert sorted(layout.cells().tolist()) == truth


def test_the_total_variation_of_leaves() -> None:
    """Against each pair of neighbours, in float64, with its gradient."""
    torch.manual_seed(2)
    cells = torch.cartesian_prod(*[torch.arange(16)] * 3)
    layout, _ = OctreeLayout.build(torch.zeros(3), 1.0, (2, 2, 2), cells[torch.rand(16**3) < 0.4])
    cells = layout.cells()
    values = torch.randn(len(cells), 3, dtype=torch.float64, requires_grad=True)
    places = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    total = torch.zeros((), dtype=torch.float64)
    for (x, y, z), row in places.items():
        squares = torch.full((), SMOOTH**2, dtype=torch.float64)
        for nearby in ((x + 1, y, z), (x, y + 1, z), (x, y, z + 1)):
            beside = places.get(nearby)
            if beside is not None and tuple(c // 8 for c in nearby) == (x // 8, y // 8, z // 8):
                squares = squares + (values[beside] - values[row]).square().sum()
        total = total + squares.sqrt() - SMOOTH
    truth = total / len(cells)
    found = leaf_variation(values, cells)
    torch.testing.assert_close(found, truth)
    torch.testing.assert_close(*(torch.autograd.grad(each, values)[0] for each in (found, truth)))
    assert float(leaf_variation(torch.ones(len(cells), 1), cells)) == pytest.approx(0, abs=1e-8)
    assert float(leaf_variation(torch.zeros(0, 3), NONE)) == 0


# -- settings, checkpoints, files -----------------------------------------------------------------------------------


def test_cells_follow_the_images_and_the_time() -> None:
    wide = replace(SCENE, image_size=400)
    for seconds, cells in ((None, 512), (15.0, 192), (60.0, 384), (300.0, 512)):
        config = replace(METHOD.config, max_seconds=seconds, machine=MachineConfig(device_type="cpu", speed=1.0))
        decided, made = METHOD.decided(config, wide)
        assert decided.resolution == cells  # type: ignore[attr-defined]
        assert [decision.choice for decision in made] == [str(cells)]


@pytest.mark.parametrize(
    ("facts", "settings", "words"),
    [
        ({"unbounded": True}, {}, "extends beyond its box: take a method for captures"),
        ({"warped": True}, {}, "leave out --ndc"),
        ({}, {"depth_loss_mult": 0.1}, "--depth-loss-mult is 0.1"),
        ({}, {"appearance": "affine"}, "--appearance is affine, and .* learns one light"),
        ({}, {"resolution": 2048, "num_splits": 1}, "raise --num-splits"),
    ],
)
def test_what_is_refused(facts: dict[str, Any], settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        METHOD.build(replace(METHOD.config, **settings), replace(SCENE, **facts))
    assert "\n" not in str(error.value)


def test_damaged_checkpoints_are_refused() -> None:
    state = {name: value.clone() for name, value in filled().state_dict().items()}
    restore_model(built(), {"model": state})  # with any leaves
    for changes in (
        {"cells": state["cells"].flip(0)},
        {"cells": state["cells"][:-1]},
        {"cells": state["cells"] + 100},
        {"densities.table": state["densities.table"][:-1]},
        {"peaks": state["peaks"][:-1]},
        {"frame": torch.tensor([0.0, 0.0, math.nan, 1.0])},
        {"frame": torch.zeros(4)},
        {"bricks": torch.zeros(3, dtype=torch.int64)},
        {"bricks": torch.full((3,), 2**20)},
    ):
        with pytest.raises(CheckpointError) as error:
            restore_model(built(), {"model": state | changes})
        assert "\n" not in str(error.value)


def test_a_run_is_written_as_an_octree(capsys: pytest.CaptureFixture[str]) -> None:
    """Without learning anew; where a file must be smaller, with the leaves that images see best."""
    model, rays = filled(), some_rays()
    datasets = {"train": ball_in_a_box()}
    loaded = Loaded(model, Placement.of(None, 1.0), "voxels", Path("run"), Path("x.ckpt"), _datasets=datasets)
    octree = bake(loaded, Baking())
    assert octree.layout.num_leaves == 512
    drawn = DrawnOctree(octree, octree.scene).light(rays, torch.ones(3), 0.0).color
    torch.testing.assert_close(drawn, colors(model, rays), atol=0.03, rtol=0)
    small = bake(loaded, Baking(max_bytes=2000))
    assert 200 < small.layout.num_leaves < 300
    assert f"0.002 MB hold {small.layout.num_leaves} of 512 leaves" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="--degree is 2"):
        bake(loaded, Baking(degree=2))
