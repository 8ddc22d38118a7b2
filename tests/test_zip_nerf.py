"""Zip-NeRF: decisions from the scene, and the effect of each part."""

import dataclasses
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.data.dataset import Dataset
from nerfloom.fields.multisampled import MultisampledField
from nerfloom.geometry.multisamples import Pattern
from nerfloom.geometry.points import Frustums, Points
from nerfloom.kernels import native
from nerfloom.kernels.grids.multisampled_grid import multisampled_grid_reference
from nerfloom.kernels.grids.multisamples import unit_multisamples_reference
from nerfloom.kernels.result_cache import Waves
from nerfloom.methods.zip_nerf import METHOD, ZipNeRFConfig
from nerfloom.rendering.light import AffineLight
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.testing import check_method
from nerfloom.training.trainer import Trainer
from tests.kernels.compiled import needs_kernels
from tests.training.helpers import TINY, chosen, said_otherwise, tiny_run, tiny_trainer

captured = partial(said_otherwise, "zip-nerf")
"""A trainer on the tiny data set with other facts of its scene."""


def test_an_object_before_no_background_needs_little(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = captured(shared_tiny, tmp_path, {})
    found = chosen(trainer)
    assert found["contraction"] == found["gradient scaling near cameras"] == found["pose refinement"] == "off"
    assert (found["distortion loss"], found["appearance"]) == ("0", "none")
    model = trainer.model
    assert (model.poses, model.appearance) == (None, None)
    assert not model.field.unbounded
    assert not model.sampler.unbounded
    assert model.field.encoding.decay == model.config.hash_decay_mult == 0


def test_proposals_are_looked_up_at_points_if_not_asked_for_the_papers(shared_tiny: Path, tmp_path: Path) -> None:
    plain = captured(shared_tiny, tmp_path / "plain", {}).model.sampler
    assert [proposal.footprint for proposal in plain.proposals] == ["none", "none"]
    assert [proposal.encoding.table.shape[1] for proposal in plain.proposals] == [2, 2]
    asked = {"multisampled_proposals": True, "hash_decay_mult": 0.1}
    model = captured(shared_tiny, tmp_path / "asked", {}, **asked).model
    assert [proposal.footprint for proposal in model.sampler.proposals] == ["frustum", "frustum"]
    assert [proposal.encoding.table.shape[1] for proposal in model.sampler.proposals] == [1, 1]
    assert [proposal.encoding.decay for proposal in model.sampler.proposals] == [0.1, 0.1]
    assert model.field.encoding.decay == 0.1


def test_an_object_is_marched_through_and_a_capture_has_proposals(shared_tiny: Path, tmp_path: Path) -> None:
    """Through a box by few steps, as cones see all of them; no setting of one is decided for the other."""
    inside = captured(shared_tiny, tmp_path / "inside", {}, sampler="auto")
    around = captured(shared_tiny, tmp_path / "around", {"unbounded": True, "has_alpha": False}, sampler="auto")
    assert chosen(inside)["sampler"] == "occupancy"
    assert (inside.model.config.samples_per_batch, inside.model.config.num_steps) == (2**14, 256)
    assert chosen(around)["sampler"] == "proposal"
    assert around.model.config.samples_per_batch is None
    assert "samples a step" not in chosen(around)


@pytest.mark.slow
def test_through_a_box_it_keeps_what_every_method_must() -> None:
    """tests/test_check_method.py checks it with proposals, beside all built-in methods."""
    marched = {"sampler": "occupancy", "grid_resolution": 16, "num_steps": 64, "samples_per_batch": 4096}
    findings = check_method(METHOD, "zip-nerf", dataclasses.replace(METHOD.config, **{**TINY["zip-nerf"], **marched}))
    assert [finding.line() for finding in findings if not finding.ok] == []


def test_a_capture_gets_what_it_needs(shared_tiny: Path, tmp_path: Path) -> None:
    facts = {"unbounded": True, "poses": "device", "appearance_varies": True, "has_alpha": False}
    trainer = captured(shared_tiny, tmp_path, facts, max_num_iterations=4)
    found = chosen(trainer)
    assert found["contraction"] == found["gradient scaling near cameras"] == "on"
    assert (found["pose refinement"], found["appearance"]) == ("SO3xR3", "affine")
    trainer.train()
    model = trainer.model
    assert isinstance(model.renderer, VolumeRenderer)
    assert model.renderer.unit_length is not None
    assert bool((model.poses.tangents != 0).any())
    assert bool((model.appearance.vectors != 0).any())
    assert (model.sampler.ladder, model.sampler.blurs) == (-1.5, (0.03, 0.003))
    report = trainer.train_step()
    assert {"rgb", "interlevel", "distortion", "appearance"} <= report.losses.keys()


def test_what_is_asked_for_is_done_and_not_called_a_decision(shared_tiny: Path, tmp_path: Path) -> None:
    asked = {"contraction": False, "hash_decay_mult": 0.0, "appearance": "none", "camera_optimizer": "off"}
    facts = {"unbounded": True, "poses": "device", "appearance_varies": True}
    trainer = captured(shared_tiny, tmp_path, facts, **asked)
    assert not {"contraction", "decay of the grids", "appearance", "pose refinement"} & chosen(trainer).keys()
    assert not trainer.model.field.unbounded


@pytest.mark.medium
@pytest.mark.parametrize(("unbounded", "multisampled"), [(True, False), (False, False), (True, True)])
def test_it_learns(unbounded: bool, multisampled: bool, shared_tiny: Path, tmp_path: Path) -> None:
    asked = {"multisampled_proposals": multisampled, "max_num_iterations": 60}
    trainer = captured(shared_tiny, tmp_path, {"unbounded": unbounded}, **asked)
    first = trainer.train_step().losses["rgb"]
    trainer.train()
    assert trainer.state.skipped == 0
    assert trainer.train_step().losses["rgb"] < first / 3


def test_a_number_for_each_proposal_is_needed() -> None:
    with pytest.raises(ConfigError, match="need one number a proposal each"):
        dataclasses.replace(ZipNeRFConfig(), interlevel_blurs=(0.03,))


def test_poses_are_refined_along_rays_of_proposals_only(shared_tiny: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs --sampler proposal"):
        captured(shared_tiny, tmp_path, {}, sampler="occupancy", camera_optimizer="SE3")


def test_marched_samples_need_no_flag_about_poses(shared_tiny: Path, tmp_path: Path) -> None:
    """Users who ask for an occupancy grid alone must not be told that poses cannot be refined."""
    trainer = captured(shared_tiny, tmp_path, {"poses": "device"}, sampler="occupancy")
    assert chosen(trainer)["pose refinement"] == "off"
    assert trainer.model.poses is None


@pytest.mark.parametrize("asked", [{}, {"contraction": True}])
def test_an_occupancy_grid_sees_all_of_space_too(asked: dict[str, object], shared_tiny: Path, tmp_path: Path) -> None:
    """The field must tell places in nested boxes apart: here two places far outside of the box."""
    trainer = captured(shared_tiny, tmp_path, {"unbounded": not asked}, sampler="occupancy", **asked)
    field = trainer.model.field
    torch.nn.init.normal_(field.encoding.table, std=0.1)
    assert trainer.model.sampler.levels > 1
    assert trainer.config.samples_per_batch
    far = field.eval().density(Points(torch.tensor([[8.0, 8.0, 8.0], [80.0, 80.0, 80.0]])))[0]
    assert far[0] != far[1]


# -- the field of frustums ----------------------------------------------------------------------------------------


@pytest.fixture
def field(shared_tiny: Path, tmp_path: Path) -> MultisampledField:
    field = tiny_trainer("zip-nerf", shared_tiny, tmp_path / "run").model.field
    torch.nn.init.normal_(field.encoding.table, std=0.1)
    return field.eval()


def cones(count: int) -> Frustums:
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    starts = torch.rand(count)
    return Frustums(
        torch.rand(count, 3) - 0.5, directions, starts, starts + 0.1, torch.full((count,), 0.05), torch.arange(count)
    )


def test_the_density_of_a_frustum_is_that_of_its_mean_features(field: MultisampledField) -> None:
    torch.manual_seed(0)
    frustums = cones(40)
    found, _ = field.density(Points(frustums.origins, frustums=frustums))
    turned = torch.pi / 6 * (torch.arange(40) % 2), 1.0 - 2 * (torch.arange(40) % 2)
    points = unit_multisamples_reference(frustums, Pattern(*turned), field.box, field.unbounded)
    features = multisampled_grid_reference(points, field.encoding.table, field.encoding.layout)
    truth = field.density_head(features)[:, 0].float().exp()
    torch.testing.assert_close(found, truth, rtol=1e-3, atol=1e-3)


def test_frustums_that_shrink_to_a_point_are_points_without_size(field: MultisampledField) -> None:
    torch.manual_seed(0)
    wide = cones(40)
    thin = dataclasses.replace(wide, t_ends=wide.t_starts, radii=torch.zeros(40))
    positions = wide.origins + wide.t_starts[:, None] * wide.directions
    found, features = field.density(Points(positions, frustums=thin))
    truth, _ = field.density(Points(positions))
    torch.testing.assert_close(found, truth, rtol=1e-3, atol=1e-3)
    assert features.shape == (40, 16)


def test_patterns_are_turned_in_training_only(field: MultisampledField) -> None:
    """The start of a frustum determines its pattern, so equal frustums have equal patterns."""
    frustums = cones(40)
    points = Points(frustums.origins, frustums=frustums)
    fixed = field.density(points)[0]
    field.train()
    turned = field.density(points)[0]
    assert not torch.equal(turned, fixed)
    assert torch.equal(turned, field.density(points)[0])


@needs_kernels
def test_what_a_march_has_evaluated_is_not_evaluated_again(field: MultisampledField) -> None:
    """This holds in training too, where patterns are turned."""
    torch.manual_seed(0)
    frustums, order = cones(60), torch.randperm(60)[:40]

    def density(rows: Tensor) -> tuple[Tensor, Tensor]:
        some = Frustums(*(x[rows] for x in vars(frustums).values() if isinstance(x, Tensor)))
        return field.density(Points(some.origins, frustums=some))

    field.train()
    waves = Waves()
    for rows in torch.arange(60).split(30):
        waves.evaluate(30, partial(density, rows))
    native.spent = {}
    try:
        found = waves.choose(order, partial(density, order))
        ran = set(native.spent)
    finally:
        native.spent = None
    assert "multisamples" in ran
    assert not {name for name in ran if name.startswith(("multisampled_grid", "mlp"))}
    torch.testing.assert_close(found[0], density(order)[0])


# -- exposures ----------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_images_of_other_exposure_get_functions_of_their_own(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each second image is darkened: its function darkens, and in the mean functions change little."""
    still: Dataset = tiny_trainer("zip-nerf", shared_tiny, tmp_path / "still").train_set
    dark = torch.arange(len(still)) % 2 == 0
    sizes = still.cameras.widths * still.cameras.heights
    dimmed, factors = still.pixels.clone(), torch.where(dark, 0.4, 1.0).repeat_interleave(sizes)
    dimmed[:, :3] = (still.pixels[:, :3] * factors[:, None]).round().to(torch.uint8)
    varied = dataclasses.replace(still, pixels=dimmed, scene=dataclasses.replace(still.scene, appearance_varies=True))
    (tmp_path / "run").mkdir()
    monkeypatch.setattr("nerfloom.rendering.light.RATE", 1e-2)
    settings = {"max_eval_images": 0, "max_num_iterations": 70}
    trainer = Trainer.of(tiny_run("zip-nerf", shared_tiny, tmp_path / "run", **settings), varied)
    trainer.train()
    light = trainer.model.light.eval()
    assert isinstance(light, AffineLight)
    grey, opaque = torch.full((len(still), 3), 0.5), torch.ones(len(still))
    shown = light.lit(grey, opaque, torch.zeros(3), torch.arange(len(still))).detach().mean(-1)
    apart = shown[~dark].mean().item() - shown[dark].mean().item()
    assert apart > 0.1
    assert abs(shown.mean().item() - 0.5) < apart
