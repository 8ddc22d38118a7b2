"""NeRF-W: its loss, compositing of two parts, held-out views, and transient vectors."""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom import Field, Points, Rays, Sampler, Samples
from nerfloom.fields.nerf import NeRFField
from nerfloom.fields.transient import TransientHead
from nerfloom.geometry.bounds import half_edge
from nerfloom.losses.functions import doubted_error
from nerfloom.losses.term import RenderedBatch
from nerfloom.methods import nerf_w
from nerfloom.methods.nerf_w import START
from nerfloom.rendering.transient import TransientRenderer
from nerfloom.testing import assert_method
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.optim import make_optimizer
from tests.training.helpers import TINY

LEAST = 0.1
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def test_the_loss_is_the_likelihood_of_a_normal_distribution() -> None:
    generator = torch.Generator().manual_seed(0)
    rgb, true = torch.rand(2, 500, 3, generator=generator, dtype=torch.float64)
    doubt = LEAST + torch.rand(500, generator=generator, dtype=torch.float64)
    weights = torch.rand(500, generator=generator, dtype=torch.float64)
    rgb.requires_grad_()
    doubt.requires_grad_()
    spread = torch.distributions.Normal(rgb, doubt[:, None])
    clear = torch.distributions.Normal(rgb.detach(), LEAST).log_prob(rgb.detach())
    expected = (2 * LEAST**2 * (clear - spread.log_prob(true)) * weights[:, None]).mean()
    found = doubted_error(rgb, true, doubt, LEAST, weights)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    for one, other in zip(*(torch.autograd.grad(x, (rgb, doubt)) for x in (found, expected)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-18)
    torch.testing.assert_close(
        doubted_error(rgb, true, torch.full_like(doubt, LEAST), LEAST), (rgb - true).square().mean()
    )
    # The best uncertainty is the root of the mean squared error, but never less than the least.
    errors = (rgb - true).detach().square().mean(-1).sqrt()
    best = errors.clamp(min=LEAST).requires_grad_()
    (slope,) = torch.autograd.grad(doubted_error(rgb.detach(), true, best, LEAST), best)
    assert float(slope[errors > LEAST].abs().max()) < 1e-15
    assert bool((slope[errors < LEAST] > 0).all())
    assert doubted_error(rgb[:0], true[:0], doubt[:0], LEAST).item() == 0


class Slabs(Field):
    """Given densities and colours, one sample after the other."""

    def __init__(self, sigma: Tensor, rgb: Tensor) -> None:
        super().__init__()
        self.sigma, self.rgb = sigma, rgb

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return self.sigma, self.rgb

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return features


class Given(TransientHead):
    """A transient part of given values, the same in every image."""

    def __init__(self, density: Tensor, color: Tensor, doubt: Tensor) -> None:
        super().__init__(3, 4, 2, 8, BOX, 0.1)
        self.given = density, color, doubt

    def forward(self, features: Tensor, positions: Tensor, vectors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.given


def two_parts() -> tuple[Rays, Samples, Slabs, Given]:
    """Two rays of five intervals, in float64."""
    generator = torch.Generator().manual_seed(1)
    sigma, density, doubt = 2 * torch.rand(3, 10, generator=generator, dtype=torch.float64)
    rgb, color = torch.rand(2, 10, 3, generator=generator, dtype=torch.float64)
    sigma[2] = density[2] = 0.0
    directions = torch.tensor([[0.0, 0, 1], [0.6, 0, 0.8]], dtype=torch.float64)
    rays = Rays(torch.zeros(2, 3, dtype=torch.float64), directions, camera_indices=torch.tensor([0, 3]))
    edges = torch.tensor([0.0, 0.3, 0.9, 1.1, 2.0, 2.7], dtype=torch.float64).repeat(2, 1)
    return rays, Samples.regular(edges[:, :-1], edges[:, 1:]), Slabs(sigma, rgb), Given(density, color, doubt)


def test_two_parts_are_composited_as_many_thin_slices() -> None:
    """Reference: 20,000 slices of each interval, with the light of equation 8; and equation 11."""
    rays, samples, field, head = two_parts()
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    found = TransientRenderer(head, LEAST, None).render(rays, samples, field, background)
    density, color, doubt = (x.double() for x in head.given)
    count = 20_000
    for ray in range(2):
        passed = alone = hazy = torch.ones(()).double()  # transmittance: both parts, the static, the transient one
        rgb, transient, static = torch.zeros(3, 3).double()
        uncertain = torch.tensor(LEAST).double()
        for i in range(5 * ray, 5 * ray + 5):
            thin = float(samples.deltas[i]) / count
            one, other = (-torch.expm1(-x * thin) for x in (field.sigma[i], density[i]))
            ahead = passed * torch.exp(-(field.sigma[i] + density[i]) * thin * torch.arange(count).double()).sum()
            rgb = rgb + ahead * (one * field.rgb[i] + other * color[i])
            transient = transient + ahead * other * color[i]
            uncertain = uncertain + hazy * -torch.expm1(-density[i] * samples.deltas[i]) * doubt[i]
            hazy = hazy * torch.exp(-density[i] * samples.deltas[i])
            passed = passed * torch.exp(-(field.sigma[i] + density[i]) * samples.deltas[i])
            static = static + alone * -torch.expm1(-field.sigma[i] * samples.deltas[i]) * field.rgb[i]
            alone = alone * torch.exp(-field.sigma[i] * samples.deltas[i])
        torch.testing.assert_close(found.rgb[ray], rgb + passed * background, atol=5e-5, rtol=0)
        torch.testing.assert_close(found.extras["transient"][ray], transient, atol=5e-5, rtol=0)
        torch.testing.assert_close(found.extras["uncertainty"][ray], uncertain, atol=5e-5, rtol=0)
        torch.testing.assert_close(found.extras["static"][ray], static + alone * background, atol=1e-12, rtol=0)
        mean = density[5 * ray : 5 * ray + 5].mean()
        torch.testing.assert_close(found.extras["transient_density"][ray], mean)


class Placed(Sampler):
    """Given samples."""

    def __init__(self, samples: Samples) -> None:
        super().__init__()
        self.samples = samples

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        return self.samples


def test_the_light_of_an_image_changes_both_parts_and_not_the_background() -> None:
    """Against colours that are changed at each sample, before they are composited."""
    rays, samples, field, head = two_parts()
    scene, behind = ball_in_a_box().scene, torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    config = nerf_w.METHOD.decided(dataclasses.replace(nerf_w.METHOD.config, appearance="affine"), scene)[0]
    renderer = TransientRenderer(head, LEAST, None)
    model = nerf_w.NerfW(config, scene, field, Placed(samples), renderer).double().eval()
    assert model.light is not None
    with torch.no_grad():
        model.light.vectors.copy_(0.3 * torch.randn(model.light.vectors.shape))
    assert rays.camera_indices is not None
    images = rays.camera_indices[samples.ray_indices]
    for indices, rows in ((rays.camera_indices, images), (None, None)):
        parameters = model.light.vectors if rows is not None else model.light.vectors.mean(0)
        affine = (parameters if rows is None else parameters[rows]).detach().view(-1, 3, 4)

        def changed(colors: Tensor, by: Tensor = affine) -> Tensor:
            return colors + (by[..., :3] * colors[:, None]).sum(-1) + by[..., 3]

        seen = dataclasses.replace(rays, camera_indices=indices)
        lit = Given(head.given[0], changed(head.given[1]), head.given[2])
        expected = TransientRenderer(lit, LEAST, None).render(
            seen, samples, Slabs(field.sigma, changed(field.rgb)), behind
        )
        found = model.render(seen, behind)
        torch.testing.assert_close(found.rgb, expected.rgb)
        torch.testing.assert_close(found.extras["static"], expected.extras["static"])
        torch.testing.assert_close(found.accumulation, expected.accumulation)


def test_rays_of_no_training_image_show_the_static_part() -> None:
    rays, samples, field, head = two_parts()
    renderer, background = TransientRenderer(head, LEAST, None), torch.zeros(3, dtype=torch.float64)
    of_image = renderer.render(rays, samples, field, background)
    held_out = renderer.render(dataclasses.replace(rays, camera_indices=None), samples, field, background)
    assert not torch.allclose(of_image.rgb, held_out.rgb)
    torch.testing.assert_close(held_out.rgb, of_image.extras["static"], rtol=0, atol=0)
    assert not held_out.extras["transient"].any()
    assert (held_out.extras["uncertainty"] == LEAST).all()
    with head.shown(3):
        shown = renderer.render(dataclasses.replace(rays, camera_indices=None), samples, field, background)
    torch.testing.assert_close(shown.rgb, of_image.rgb, rtol=0, atol=0)
    assert head.vectors_of(dataclasses.replace(rays, camera_indices=None)) is None


def test_before_training_the_transient_part_is_nearly_transparent() -> None:
    box = torch.tensor([[-3.0] * 3, [3.0] * 3])
    torch.manual_seed(0)
    head = TransientHead(16, 5, 16, 64, box, START / half_edge(box))
    positions = 6 * torch.rand(1000, 3) - 3
    density, color, doubt = head(torch.randn(1000, 16), positions, torch.randn(1000, 16))
    assert density.shape == doubt.shape == (1000,)
    assert color.shape == (1000, 3)
    assert float(density.detach().median()) * 2 * half_edge(box) < 4 * START  # optical depth across the box
    assert float(doubt.detach().min()) > 0
    other = head(torch.zeros(1, 16), torch.zeros(1, 3), torch.ones(1, 16))
    assert not torch.equal(other[1], head(torch.zeros(1, 16), torch.zeros(1, 3), torch.zeros(1, 16))[1])


def test_each_image_has_its_own_vector() -> None:
    head = TransientHead(16, 3, 2, 8, BOX, 0.1)
    with torch.no_grad():
        head.vectors.copy_(torch.arange(6.0).view(3, 2))
    rays = Rays(torch.zeros(4, 3), torch.tensor([[0.0, 0, 1]]).repeat(4, 1), camera_indices=torch.tensor([2, 0, 1, 2]))
    found = head.vectors_of(rays)
    assert found is not None
    assert found.tolist() == [[4, 5], [0, 1], [2, 3], [4, 5]]


@pytest.mark.parametrize(("encoding", "rate"), [("frequency", 5e-4), ("hash-grid", 1e-2), ("planes", 1e-2)])
def test_field_and_transient_head_learn_at_the_same_rate(encoding: str, rate: float) -> None:
    """The paper's, 5e-4, for the paper's networks."""
    scene, small = ball_in_a_box().scene, {"log2_table_size": 12, "grid_resolution": 16}
    config, _ = nerf_w.METHOD.decided(dataclasses.replace(nerf_w.METHOD.config, encoding=encoding, **small), scene)
    model = nerf_w.METHOD.build(config, scene)
    groups = make_optimizer(model, config).param_groups
    assert [group["lr"] for group in groups] == pytest.approx([rate] * len(groups))
    assert sum(len(group["params"]) for group in groups) == len(list(model.parameters()))


@pytest.mark.parametrize("contraction", [False, True])
@pytest.mark.parametrize("unbounded", [False, True])
def test_the_paper_network_contracts_space_if_asked(unbounded: bool, contraction: bool) -> None:
    scene = dataclasses.replace(ball_in_a_box().scene, unbounded=unbounded)
    config = dataclasses.replace(nerf_w.METHOD.config, encoding="frequency", contraction=contraction)
    field = nerf_w.make_field(nerf_w.METHOD.decided(config, scene)[0], scene)
    assert isinstance(field, NeRFField)
    assert (field.contracted is not None) == contraction


def test_planes_have_a_vertex_for_each_pixel_and_their_variation_counts() -> None:
    """The variation in float64 over all rows; a step reads a random band of them."""
    scene, settings = (
        dataclasses.replace(ball_in_a_box().scene, image_size=100),
        {**TINY["nerf-w"], "encoding": "planes"},
    )
    config = nerf_w.METHOD.decided(dataclasses.replace(nerf_w.METHOD.config, **settings), scene)[0]
    model: Any = nerf_w.METHOD.build(config, scene)
    planes = model.field.encoding
    assert planes.resolutions.tolist() == [[64] * 3, [128] * 3]
    factors = [planes.layout.factor(planes.table.detach().double(), *factor) for factor in planes.all_factors]
    steps = [x.diff(dim=axis).square().mean() for x in factors for axis in (0, 1)]
    expected = torch.stack(steps).sum() / (2 * len(factors))
    batch = RenderedBatch(batch=None, rendered=None, model=model, step=0)  # type: ignore[arg-type]
    torch.manual_seed(0)
    found = torch.stack([nerf_w.PlaneVariation("planes")(batch).detach() for _ in range(50)]).mean()
    assert float(found) == pytest.approx(float(expected), rel=0.05)  # a band of one row has no steps
    assert nerf_w.PlaneVariation("planes").applies(batch.batch, model)
    model.config = dataclasses.replace(config, encoding="hash-grid")
    assert not nerf_w.PlaneVariation("planes").applies(batch.batch, model)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [TINY["nerf-w+frequency"], {**TINY["nerf-w"], "encoding": "planes"}])
def test_other_encodings_pass(settings: dict[str, Any]) -> None:
    assert_method(nerf_w.METHOD, "nerf-w", dataclasses.replace(nerf_w.METHOD.config, **settings))
