"""Fields: the properties that every sampler and renderer relies on, for each field."""

import pytest
import torch

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import Field
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.nerf import NeRFField
from nerfloom.fields.network_grid import NetworkGrid
from nerfloom.geometry.points import Points

BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])


def make(kind: str) -> Field:
    torch.manual_seed(0)
    if kind == "nerf":
        return NeRFField()
    if kind == "networks":
        networks = NetworkGrid(BOX, 2)
        networks.trunk.deferred = networks.color_head.deferred = None  # autograd accumulates the gradients
        return networks
    return EncodedField(BOX, HashGrid(num_levels=4, max_resolution=64, log2_table_size=12))


@pytest.mark.parametrize("kind", ["nerf", "hash", "networks"])
@pytest.mark.parametrize("count", [0, 1, 50])
@pytest.mark.parametrize("half", [True, False])
def test_shapes_types_and_gradients(kind: str, count: int, half: bool) -> None:
    field = make(kind)
    positions = torch.rand(count, 3) * 3 - 1.5
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        sigma, features = field.density(Points(positions))
        rgb = field.color(features, directions)
    assert sigma.shape == (count,)
    assert rgb.shape == (count, 3)
    assert sigma.dtype == rgb.dtype == torch.float32
    assert bool((sigma >= 0).all())
    assert bool(((rgb >= 0) & (rgb <= 1)).all())
    (sigma.sum() + rgb.sum()).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        if count == 50:
            assert bool(parameter.grad.any()), name


def test_the_papers_parameter_count() -> None:
    """63 inputs, 8 layers of 256 with 63 more at the sixth, density, 256 features, 128 with 27 of the direction."""
    trunk = (63 * 256 + 256) + 6 * (256 * 256 + 256) + ((256 + 63) * 256 + 256)
    heads = (256 + 1) + (256 * 256 + 256) + ((256 + 27) * 128 + 128) + (128 * 3 + 3)
    assert sum(p.numel() for p in NeRFField().parameters()) == trunk + heads


def test_density_starts_alive() -> None:
    """A ReLU density that is zero everywhere would never learn."""
    sigma, _ = make("nerf").density(Points(torch.rand(2000, 3) * 3 - 1.5))
    assert (sigma > 0).float().mean() > 0.1
