"""The sums of planes and lines that `tensorf` learns."""

import torch

from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.tensor import VM, TensorField
from nerfloom.geometry.points import Points

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def test_the_shift_of_a_softplus_density_is_that_of_the_checkpoint() -> None:
    """What was trained before the shift was another, and before it was saved, keeps the density that it had."""

    def field() -> TensorField:
        cubes = ((5, 5, 5),) * 3
        return TensorField(BOX, *(FeaturePlanes(cubes, count, VM) for count in (2, 3)), width=8)

    new, old = field(), field().state_dict()
    del old["density_shift"]
    points = Points(torch.rand(20, 3) - 0.5)
    new.load_state_dict(field().state_dict())
    ours = new.density(points)[0]
    new.load_state_dict(old)
    assert new.density_shift.item() == -10
    assert new.density(points)[0].max().item() < 0.02 * ours.min().item()
