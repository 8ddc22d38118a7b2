"""Projections in parts, against matrices that were put together from known ones."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerfloom.base.errors import DataError
from nerfloom.dataparsers.numbered import partners
from nerfloom.dataparsers.projections import check_skew, factored, size_made_for

COUNT = 40


def made(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Intrinsic matrices, rotations to the camera, positions, and their product with any factor, also negative."""
    random = np.random.default_rng(seed)
    rotations = Rotation.random(COUNT, random_state=seed).as_matrix()
    positions = random.normal(size=(COUNT, 3)) * 10 ** random.uniform(-3, 4, (COUNT, 1))
    intrinsic = np.zeros((COUNT, 3, 3))
    intrinsic[:, 0, 0], intrinsic[:, 1, 1] = random.uniform(100, 5000, (2, COUNT))
    intrinsic[:, 0, 1] = random.uniform(-3, 3, COUNT)
    intrinsic[:, :2, 2] = random.uniform(50, 3000, (COUNT, 2))
    intrinsic[:, 2, 2] = 1
    outer = np.concatenate([rotations, -rotations @ positions[:, :, None]], -1)
    factors = random.choice([-1.0, 1.0], (COUNT, 1, 1)) * 10 ** random.uniform(-6, 6, (COUNT, 1, 1))
    return intrinsic, rotations, positions, factors * (intrinsic @ outer)


def test_a_projection_comes_apart_into_what_it_was_made_of() -> None:
    intrinsic, rotations, positions, matrices = made()
    found = factored(torch.from_numpy(matrices), [str(index) for index in range(COUNT)])
    expected = np.stack([intrinsic[:, 0, 0], intrinsic[:, 1, 1], intrinsic[:, 0, 2], intrinsic[:, 1, 2]], -1)
    errors = {
        "intrinsics": np.abs(found.intrinsics.numpy() / expected - 1).max(),
        "skew": np.abs(found.skews.numpy() / intrinsic[:, 0, 1] - 1).max(),
        "rotations": np.abs(found.poses[:, :3, :3].mT.numpy() - np.diag([1, -1, -1]) @ rotations).max(),
        "positions": (
            np.linalg.norm(found.poses[:, :3, 3].numpy() - positions, axis=-1) / np.linalg.norm(positions, axis=-1)
        ).max(),
    }
    print({name: f"{error:.1e}" for name, error in errors.items()})
    assert errors["intrinsics"] < 1e-9
    assert errors["skew"] < 1e-7  # of 3 pixels beside thousands
    assert errors["rotations"] < 1e-9
    assert errors["positions"] < 1e-9


def test_what_projects_nothing_is_refused() -> None:
    matrices = torch.from_numpy(made()[-1])
    for change in (lambda m: m.zero_(), lambda m: m[1].copy_(m[0]), lambda m: m[2, :3].zero_()):
        bad = matrices.clone()
        change(bad[7])
        with pytest.raises(DataError, match=r"^7 is singular.*; correct the matrix"):
            factored(bad, [str(index) for index in range(COUNT)])
    matrices[3, 1, 3] = torch.nan
    with pytest.raises(DataError, match=r"^3 has entries that are not finite"):
        factored(matrices, [str(index) for index in range(COUNT)])


@pytest.mark.parametrize("factor", [1, 2, 3, 4, 6, 8, 1 / 2, 1 / 4])
@pytest.mark.parametrize("off", [0.92, 1.0, 1.08])
def test_the_size_that_cameras_were_made_for_is_told_by_the_principal_point(factor: float, off: float) -> None:
    images = torch.tensor([[960, 720]]).repeat(5, 1)
    sizes, _ = size_made_for(images * factor / 2 * off, images, None, None, "file")
    assert torch.equal(sizes, (images * factor).long())


def test_a_stated_size_counts_if_the_principal_point_agrees() -> None:
    images = torch.tensor([[960, 720]]).repeat(5, 1)
    near = torch.tensor([[610.0, 460.0]]).double().repeat(5, 1)
    assert size_made_for(near, images, (1200.0, 900.0), None, "file")[0][0].tolist() == [1200, 900]
    with pytest.raises(DataError, match=r"610, 460.*960x720.*--camera-width"):
        size_made_for(near, images, (3000.0, 2250.0), None, "file")
    assert size_made_for(near, images, None, 1280, "file")[0][0].tolist() == [1280, 960]


def test_a_skew_is_left_out_while_nobody_sees_it(capsys: pytest.CaptureFixture[str]) -> None:
    """A skew s moves a pixel at height y by s * (y - cy) / fy: here by s / 2 at most."""
    intrinsics, sizes = torch.tensor([[100.0, 100.0, 50.0, 50.0]]).double(), torch.tensor([[100, 100]])
    check_skew(torch.tensor([0.01]), intrinsics, sizes, ["view"], quiet=False)
    assert capsys.readouterr().err == ""
    check_skew(torch.tensor([-0.8]), intrinsics, sizes, ["view"], quiet=False)
    assert "view has a skew" in (said := capsys.readouterr().err)
    assert "0.4" in said
    with pytest.raises(DataError, match=r"^view has a skew that displaces pixels by 0\.6"):
        check_skew(torch.tensor([1.2]), intrinsics, sizes, ["view"], quiet=False)


@pytest.mark.parametrize(
    ("names", "others", "expected"),
    [
        (["000000.png", "000001.png"], ["000.png", "001.png"], ([0, 1], "number")),
        (["a.png", "b.png"], ["b.jpg", "a.jpg"], ([1, 0], "name")),
        (["3.png", "7.png"], ["0", "3", "5", "7"], ([1, 3], "name")),
        (["1.png", "2.png", "3.png"], ["0", "1", "2"], ([0, 1, 2], "order")),
        (["0.png", "1.png", "9.png"], ["0", "1"], ([0, 1, None], "name")),
        (["rect_001_3_r5000.png", "rect_002_3_r5000.png"], ["0", "1"], ([0, 1], "order")),
        (["1.png", "10.png", "2.png"], ["0", "1", "9"], ([0, 2, 1], "order")),
        (["0.png", "2.png", "3.png"], ["000.png", "001.png", "003.png"], ([0, None, 2], "number")),
        (["left.png", "right.png"], ["0", "1", "2"], ([None, None], "name")),
        (["1.png", "01.png", "2.png"], ["1", "2"], ([0, None, 1], "name")),
    ],
)
def test_what_belongs_together(names: list[str], others: list[str], expected: tuple[list[int | None], str]) -> None:
    assert partners(names, others) == expected
