"""Normals of densities that are known, and a head that learns them."""

import torch
from torch import Tensor

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.base import Field
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.normals import NormalHead, density_normals, normal_penalties
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Samples


class Ball(Field):
    """Denser towards the middle."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return torch.exp(-points.positions.square().sum(-1)), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        raise AssertionError


def test_a_balls_normals_point_outwards() -> None:
    positions = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    found = density_normals(Ball(), Points(positions))
    torch.testing.assert_close(found, positions / positions.norm(dim=-1, keepdim=True))
    assert not found.requires_grad


def test_in_the_middle_there_is_none() -> None:
    assert density_normals(Ball(), Points(torch.zeros(1, 3))).tolist() == [[0, 0, 0]]


def test_asking_for_normals_teaches_the_field_nothing() -> None:
    """A table's gradient that waits for the optimiser must not be touched by the second evaluation."""
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    field = EncodedField(box, HashGrid(4, 2, 16, 64, 10, sparse=True))
    torch.nn.init.normal_(field.encoding.table)
    positions = torch.rand(20, 3) * 2 - 1
    with torch.no_grad():
        normals = density_normals(field, Points(positions))
    assert field.encoding.deferred is not None
    assert field.encoding.deferred.parts == []
    assert all(p.grad is None and p.requires_grad for p in field.parameters())
    step = 1e-3
    ends = [[field.density(Points(positions + sign * step * axis))[0] for sign in (1, -1)] for axis in torch.eye(3)]
    numeric = torch.stack([(ahead - behind).detach() for ahead, behind in ends], dim=-1)
    agreement = -(normals * numeric / numeric.norm(dim=-1, keepdim=True)).sum(-1)
    assert agreement.median() > 0.99  # cells are small: some differences straddle a face


def test_penalties_in_closed_form() -> None:
    """One ray's normal is right and faces the camera, the other's is opposite and faces away."""
    samples = Samples.regular(torch.zeros(2, 1), torch.ones(2, 1))
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    predicted = normals * torch.tensor([[1.0], [-1.0]])
    directions = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
    found = normal_penalties(predicted, normals, directions, torch.tensor([0.5, 0.5]), samples)
    assert found["normals_penalty"].tolist() == [0.0, 1.0]
    assert found["orientation_penalty"].tolist() == [0.0, 0.5]


def test_the_head_learns_a_balls_normals() -> None:
    torch.manual_seed(0)
    head, ball = NormalHead(3), Ball()
    optimizer = torch.optim.Adam(head.parameters(), lr=5e-3)
    samples = Samples.regular(torch.zeros(256, 1), torch.ones(256, 1))
    for _ in range(150):
        positions = torch.rand(256, 3) * 2 - 1
        found = density_normals(ball, Points(positions))
        predicted = head(positions, positions)
        loss = normal_penalties(predicted, found, -positions, torch.ones(256), samples)["normals_penalty"].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.02
    assert head(torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0, 3)
