"""Fields that are asked about cones: they blur with the size of points, on networks and on grids, near and far."""

import pytest
import torch

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.integrated import IntegratedEncoding
from nerfloom.encodings.multisampled import MultisampledHashGrid
from nerfloom.fields.base import Field
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.integrated import IntegratedDensity, IntegratedField
from nerfloom.fields.sized import SizedDensity, SizedField
from nerfloom.geometry.points import Points, sample_points
from nerfloom.geometry.rays import Rays, Samples

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def grid(levels: int = 3) -> MultisampledHashGrid:
    torch.manual_seed(0)
    made = MultisampledHashGrid(levels, 2, 4, 64, 12)
    made.table.data.uniform_(-1, 1)
    return made


def cones(field: Field, radius: float, count: int = 40, length: float = 0.01, far: float = 1.0) -> Points:
    torch.manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    rays = Rays(torch.rand(count, 3) - 0.5, directions, pixel_radii=torch.full((count,), radius))
    starts = far * (0.2 + 0.2 * torch.rand(count, 1))
    return sample_points(rays, Samples.regular(starts, starts + length * far), field.footprint)


def fields(unbounded: bool = False) -> list[Field]:
    encoding = IntegratedEncoding(BOX, 6, 1e-3, unbounded)
    torch.manual_seed(0)
    return [
        IntegratedField(encoding, 32, 3, 2),
        IntegratedDensity(encoding, 16, 2),
        SizedField(BOX, grid(), unbounded=unbounded),
        SizedDensity(BOX, grid(), unbounded=unbounded),
    ]


@pytest.mark.parametrize("unbounded", [False, True])
def test_small_cones_are_points_and_large_ones_are_blurred(unbounded: bool) -> None:
    """The cones have the same axes: detail of a grid or of waves between them is lost as they widen."""
    for field in fields(unbounded):
        found = {}
        for radius in (1e-6, 1e-5, 0.3, 30.0):
            sigma, features = field.density(cones(field, radius, length=1e-5))
            assert sigma.shape == (40,)
            assert bool((sigma >= 0).all())
            found[radius] = features.detach() if isinstance(field, (SizedDensity, IntegratedField)) else sigma.detach()
        assert (found[1e-6] - found[1e-5]).abs().max() < 1e-3 * found[1e-6].abs().max()
        assert (found[30.0] - found[1e-6]).abs().max() > 0.01 * found[1e-6].abs().max()


@pytest.mark.parametrize("unbounded", [False, True])
def test_an_unsized_grid_is_the_limit_of_points(unbounded: bool) -> None:
    sized, plain = (
        SizedField(BOX, grid(), unbounded=unbounded),
        EncodedField(BOX, HashGrid(3, 2, 4, 64, 12), unbounded=unbounded),
    )
    plain.load_state_dict(sized.state_dict())
    points = cones(sized, 1e-7, length=1e-7, far=5.0)
    torch.testing.assert_close(sized.density(points)[0], plain.density(points)[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("unbounded", [False, True])
def test_positions_alone_have_half_a_cell(unbounded: bool) -> None:
    field = SizedField(BOX * 5, grid(), unbounded=unbounded)
    balls = field.balls(Points(torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])))
    assert balls[:, :3].flatten().tolist() == pytest.approx([0.5] * 3 + [0.75 if unbounded else 1.0, 0.5, 0.5])
    assert balls[:, 3].tolist() == pytest.approx([0.5 / 64] * 2)


@pytest.mark.parametrize("unbounded", [False, True])
def test_sizes_in_a_grid_are_in_its_units(unbounded: bool) -> None:
    """A ball of a tenth of the box's edge in its middle: a tenth of the grid, or a twentieth where all space fits."""
    field = SizedField(BOX * 5, grid(), unbounded=unbounded)
    ball = field.balls(Points(torch.zeros(1, 3)).sized(1.0))[0]
    assert ball.tolist() == pytest.approx([0.5, 0.5, 0.5, 0.05 if unbounded else 0.1])
    if unbounded:  # at distance 10 of the half edge: (2 - 1/10) / 10 across, 1 / 100 along
        far = field.balls(Points(torch.tensor([[50.0, 0.0, 0.0]])).sized(1.0))[0]
        assert far[3].item() == pytest.approx(0.05 * (0.19 * 0.19 * 0.01) ** (1 / 3), rel=1e-4)


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("far", [1.0, 1e4])
def test_values_and_gradients_are_finite_and_colours_reach_black_and_white(unbounded: bool, far: float) -> None:
    for field in fields(unbounded):
        points = cones(field, 0.01, length=1.0, far=far)
        sigma, features = field.density(points)
        total = sigma.sum()
        if isinstance(field, (IntegratedField, SizedField)):
            rgb = field.color(features, torch.nn.functional.normalize(points.positions, dim=-1))
            assert bool((rgb >= -0.0011).all())
            assert bool((rgb <= 1.0011).all())
            total = total + rgb.sum()
        total.backward()
        assert all(p.grad is None or bool(p.grad.isfinite().all()) for p in field.parameters())
        assert any(p.grad is not None and bool((p.grad != 0).any()) for p in field.parameters())


def test_fields_are_asked_about_mere_positions_too() -> None:
    """Exports and the updates of occupancy grids do so; no position is allowed too."""
    for field in fields():
        sigma, _ = field.density(Points(torch.rand(7, 3) - 0.5))
        assert bool(sigma.isfinite().all())
        assert field.density(Points(torch.zeros(0, 3)))[0].shape == (0,)


def test_a_density_field_has_no_colours() -> None:
    with pytest.raises(NotImplementedError, match="no colours"):
        IntegratedDensity(IntegratedEncoding(BOX, 2, 1.0), 4, 1).color(torch.zeros(1, 1), torch.zeros(1, 3))
