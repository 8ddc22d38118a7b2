"""mip-nerf and mip-nerf-360: their parts, decisions and objectives."""

import dataclasses
from typing import Any

import pytest
import torch

from nerfloom.base.machine_config import MachineConfig
from nerfloom.data.scene import Scene
from nerfloom.fields.integrated import IntegratedDensity, IntegratedField
from nerfloom.fields.sized import SizedDensity, SizedField
from nerfloom.losses.functions import charbonnier, mean_squared_error, normalised_distortion
from nerfloom.methods import mip_nerf, mip_nerf_360
from nerfloom.methods.vanilla_nerf import OCCUPANCY_SAMPLES_PER_BATCH
from nerfloom.ray_model import RayModel
from nerfloom.samplers.hierarchical import HierarchicalSampler
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.proposal import ProposalSampler
from nerfloom.stress.scenes import ball_views
from nerfloom.testing import check_method
from nerfloom.testing.method_under_test import Learner
from nerfloom.testing.scenes import ball_in_a_box, ball_under_a_sky
from tests.training.helpers import TINY

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
BOUNDED = Scene(BOX, 2.0, 6.0, num_cameras=3, has_alpha=True, moving=False, image_size=800)
UNBOUNDED = dataclasses.replace(BOUNDED, unbounded=True, has_alpha=False)
CPU = MachineConfig(device_type="cpu")
VARIANTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "mip-nerf --sampler occupancy": (
        mip_nerf.METHOD,
        {**TINY["mip-nerf"], "sampler": "occupancy", "grid_resolution": 16, "num_steps": 64, "samples_per_batch": 4096},
    ),
    "mip-nerf-360 --encoding integrated": (mip_nerf_360.METHOD, TINY["mip-nerf-360+integrated"]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_each_variant_keeps_what_every_method_must(name: str) -> None:
    """The others are checked beside all built-in methods in tests/test_check_method.py."""
    method, settings = VARIANTS[name]
    findings = check_method(method, name, dataclasses.replace(method.config, **settings))
    assert [finding.line() for finding in findings if not finding.ok] == []


def test_mip_nerf_is_one_network_of_the_papers_shape() -> None:
    model = mip_nerf.METHOD.build(mip_nerf.METHOD.config, BOUNDED)
    assert isinstance(model, RayModel)
    assert isinstance(model.field, IntegratedField)
    assert isinstance(model.sampler, HierarchicalSampler)
    assert model.sampler.coarse is None
    assert (model.sampler.num_coarse, model.sampler.num_fine) == (128, 128)
    # 8 layers of 256 with a skip connection, a density, a bottleneck, and a layer of 128 for colours: 3 axes, 16
    # frequencies of positions; 3 axes, 4 frequencies and the direction itself.
    encoded, wide = 96, 256
    trunk = (encoded + 1) * wide + 4 * (wide + 1) * wide + (wide + encoded + 1) * wide + 2 * (wide + 1) * wide
    heads = (wide + 1) + (wide + 1) * wide + (wide + 27 + 1) * 128 + (128 + 1) * 3
    assert model.size() == trunk + heads


def test_mip_nerf_360_has_the_papers_networks_and_one_proposal() -> None:
    config = dataclasses.replace(mip_nerf_360.METHOD.config, encoding="integrated")
    model = mip_nerf_360.METHOD.build(config, UNBOUNDED)
    assert isinstance(model, RayModel)
    assert isinstance(model.sampler, ProposalSampler)
    assert model.sampler.counts == (64, 64, 32)
    first, second = model.sampler.proposals
    assert first is second
    assert isinstance(first, IntegratedDensity)
    encoded, wide = 2 * 21 * 12, 256
    assert sum(p.numel() for p in first.parameters()) == (encoded + 1) * wide + 3 * (wide + 1) * wide + wide + 1
    assert isinstance(model.field, IntegratedField)
    assert [layer.out_features for layer in model.field.before_skip if isinstance(layer, torch.nn.Linear)] == [1024] * 5
    assert not model.field.runs_on_kernels
    assert model.field.encoding.contracted
    assert model.sampler.learn_every == 1


def test_the_encoding_is_decided_by_the_device() -> None:
    config = dataclasses.replace(mip_nerf_360.METHOD.config, machine=CPU)
    found, made = mip_nerf_360.decide(config, UNBOUNDED)
    assert found.encoding == "hash-grid"
    reasons = {decision.option: decision.reason for decision in made}
    assert "take days on a processor" in reasons["encoding"]
    assert reasons["samples a ray"] == "there is time for it"
    assert found.camera_optimizer == "off"
    tracked = dataclasses.replace(UNBOUNDED, poses="device")
    assert mip_nerf_360.decide(config, tracked)[0].camera_optimizer == "SO3xR3"
    assert found.distortion_loss_mult == 0.01
    assert mip_nerf_360.decide(config, BOUNDED)[0].distortion_loss_mult == 0
    on_gpu = dataclasses.replace(config, machine=MachineConfig(device_type="cuda"))
    assert mip_nerf_360.decide(on_gpu, UNBOUNDED)[0].encoding == "integrated"
    hurried = dataclasses.replace(on_gpu, max_seconds=600.0)
    assert mip_nerf_360.decide(hurried, UNBOUNDED)[0].encoding == "hash-grid"
    asked = dataclasses.replace(
        config, encoding="integrated", distortion_loss_mult=0.5, max_seconds=60.0, camera_optimizer="off"
    )
    papers = dataclasses.replace(asked, num_proposal_samples=(64, 64), num_nerf_samples=32)
    assert mip_nerf_360.decide(asked, UNBOUNDED) == (papers, [])
    model = mip_nerf_360.METHOD.build(config, UNBOUNDED)
    assert isinstance(model, RayModel)
    assert isinstance(model.field, SizedField)
    assert isinstance(model.sampler, ProposalSampler)
    assert [type(proposal) for proposal in model.sampler.proposals] == [SizedDensity, SizedDensity]
    assert model.field.unbounded


@pytest.mark.parametrize(
    ("scene", "asked", "kind"),
    [
        (BOUNDED, "auto", HierarchicalSampler),
        (UNBOUNDED, "auto", ProposalSampler),
        (BOUNDED, "occupancy", OccupancySampler),
    ],
)
def test_mip_nerfs_sampler_is_decided_by_the_scene(scene: Scene, asked: str, kind: type) -> None:
    config = dataclasses.replace(mip_nerf.METHOD.config, sampler=asked, **{"num_layers": 3, "hidden_width": 8})
    decided, _ = mip_nerf.decide(config, scene)
    model = mip_nerf.METHOD.build(decided, scene)
    assert isinstance(model, RayModel)
    assert isinstance(model.sampler, kind)
    assert isinstance(model.field, IntegratedField)
    assert model.field.encoding.contracted == scene.unbounded
    assert model.samples_per_step == (OCCUPANCY_SAMPLES_PER_BATCH if asked == "occupancy" else None)


def test_the_coarse_level_of_mip_nerf_counts_a_tenth() -> None:
    learner = Learner(
        mip_nerf.METHOD, dataclasses.replace(mip_nerf.METHOD.config, **TINY["mip-nerf"]), ball_in_a_box(), 0
    )
    batch = learner.batch()
    torch.manual_seed(1)
    terms = learner.loss(batch).terms
    torch.manual_seed(1)
    rendered = learner.rendered(batch.rays, batch.background)
    assert rendered.coarse is not None
    assert terms["rgb"].item() == pytest.approx(mean_squared_error(rendered.rgb, batch.rgb).item(), rel=1e-5)
    coarse = mean_squared_error(rendered.coarse.rgb, batch.rgb).item()
    assert terms["rgb_coarse"].item() == pytest.approx(0.1 * coarse, rel=1e-5)


def test_what_mip_nerf_360_minimises() -> None:
    config = dataclasses.replace(mip_nerf_360.METHOD.config, machine=CPU, **TINY["mip-nerf-360"])
    learner = Learner(mip_nerf_360.METHOD, config, ball_under_a_sky(), 0)
    batch = learner.batch()
    torch.manual_seed(1)
    terms = learner.loss(batch).terms
    assert set(terms) == {"rgb", "interlevel", "distortion"}
    torch.manual_seed(1)
    rendered = learner.rendered(batch.rays, batch.background)
    errors = ((rendered.rgb - batch.rgb).square() + 1e-6).sqrt()
    assert terms["rgb"].item() == pytest.approx(errors.mean().item(), rel=1e-5)
    assert rendered.samples is not None
    assert rendered.weights is not None
    spread = normalised_distortion(rendered.weights, rendered.samples).item()
    assert terms["distortion"].item() == pytest.approx(0.01 * spread, rel=1e-4)


def test_in_a_box_mip_nerf_360_minimises_squares() -> None:
    """Absolute errors are least for nothing at all where most pixels show the background; networks stay there."""
    learner = Learner(mip_nerf_360.METHOD, tiny_networks(), ball_in_a_box(), 0)
    batch = learner.batch()
    torch.manual_seed(1)
    terms = learner.loss(batch).terms
    assert set(terms) == {"rgb", "interlevel"}
    torch.manual_seed(1)
    rendered = learner.rendered(batch.rays, batch.background)
    assert terms["rgb"].item() == pytest.approx(mean_squared_error(rendered.rgb, batch.rgb).item(), rel=1e-5)


@pytest.mark.slow
def test_networks_do_not_stay_empty_before_a_large_background() -> None:
    learner = Learner(mip_nerf_360.METHOD, tiny_networks(), ball_views().train, 42)
    before = learner.error()
    for _ in range(100):
        learner.step()
    assert learner.error() < 0.2 * before


def tiny_networks() -> mip_nerf_360.MipNeRF360Config:
    return dataclasses.replace(mip_nerf_360.METHOD.config, machine=CPU, **TINY["mip-nerf-360+integrated"])


def test_the_charbonnier_error_is_square_for_small_differences_and_absolute_for_large_ones() -> None:
    zero, weights = torch.zeros(2, 3, dtype=torch.float64), torch.tensor([0.5, 1.5], dtype=torch.float64)
    assert charbonnier(zero + 0.5, zero).item() == pytest.approx(0.5, rel=1e-5)
    assert charbonnier(zero + 1e-5, zero).item() - 1e-3 == pytest.approx(1e-10 / 2e-3, rel=1e-3)
    different = torch.tensor([[0.3] * 3, [0.0] * 3], dtype=torch.float64)
    by_hand = (0.5 * (0.09 + 1e-6) ** 0.5 + 1.5 * 1e-3) / 2
    assert charbonnier(different, zero, weights).item() == pytest.approx(by_hand)
    assert charbonnier(zero[:0], zero[:0]).item() == 0
    same = zero.clone().requires_grad_()
    charbonnier(same, zero).backward()
    assert same.grad is not None
    assert bool((same.grad == 0).all())
