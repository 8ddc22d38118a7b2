"""Photographs of the courtyard: distractors in them, the pixels that these change, and the light."""

import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.procedural import Procedural
from nerfloom.dataparsers.procedural.courtyard import COURTYARD, HALF, courtyard_poses
from nerfloom.dataparsers.procedural.crowd import cast, crowds
from nerfloom.dataparsers.procedural.photographs import SHOWN, TOUCHED, Changing, lights, write_photographs
from nerfloom.dataparsers.procedural.scene import DAYLIGHT, Light, Parts
from nerfloom.dataparsers.procedural.shapes import Box, Sphere, Union
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE, render_view, visible_parts

SIZE, COUNTS = 40, {"train": 6, "val": 1, "test": 2}


def images(folder: Path, split: str, ending: str = "") -> np.ndarray:
    return np.stack([iio.imread(folder / split / f"r_{i:03d}{ending}.png") for i in range(COUNTS[split])])


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same photographs with and without distractors."""
    around = tmp_path_factory.mktemp("photographs")
    for name, share in (("crowd", 0.2), ("clean", 0.0)):
        write_photographs(
            around / name, size=SIZE, counts=COUNTS, distractors=share, changing=Changing(exposure=True), seed=3
        )
    return around / "crowd", around / "clean"


@pytest.mark.medium
def test_only_what_the_truth_says_differs(folders: tuple[Path, Path]) -> None:
    crowd, clean = folders
    truth = images(crowd, "train", "_truth")
    same = (images(crowd, "train") == images(clean, "train")).all(-1)
    assert set(np.unique(truth)) <= {0, TOUCHED, SHOWN}
    assert same[truth == 0].all()
    assert not same[truth == TOUCHED].any()
    assert same[truth == SHOWN].mean() < 0.02  # of a colour by chance
    assert not images(clean, "train", "_truth").any()
    for split in ("val", "test"):
        assert (images(crowd, split) == images(clean, split)).all()


@pytest.mark.medium
def test_test_images_are_the_courtyard_in_daylight(folders: tuple[Path, Path]) -> None:
    for shown, pose in zip(images(folders[0], "test"), courtyard_poses("test", COUNTS["test"], 3), strict=True):
        alone = render_view(pose, CAMERA_ANGLE, SIZE, SIZE, geometry=False, parts=COURTYARD, lit=DAYLIGHT)[0]
        assert (shown == alone).all()
        assert (shown[..., 3] == 255).all()


@pytest.mark.medium
def test_the_truth_is_where_rays_meet_a_figure(folders: tuple[Path, Path]) -> None:
    """Along each pixel's ray, a distance to the figures of zero lies in front of the courtyard's surface."""
    poses = courtyard_poses("train", COUNTS["train"], 3)
    truth = images(folders[0], "train", "_truth")
    for pose, people, shown in zip(poses, crowds(poses, 0.2, 3), truth, strict=True):
        depth, _ = visible_parts(pose, (SIZE, SIZE), COURTYARD)
        pixels = np.arange(SIZE) + 0.5 - SIZE / 2
        local = np.stack(
            np.broadcast_arrays(pixels[None], -pixels[:, None], -SIZE / 2 / math.tan(CAMERA_ANGLE / 2)), -1
        )
        rays = torch.from_numpy(local / np.linalg.norm(local, axis=-1, keepdims=True) @ pose[:3, :3].T).reshape(-1, 3)
        reach, met = torch.from_numpy(depth).flatten(), torch.zeros(SIZE**2, dtype=torch.bool)
        travelled = torch.zeros(SIZE**2, dtype=torch.float64)
        for _ in range(80):  # sphere tracing
            there = torch.from_numpy(pose[:3, 3])[:, None] + travelled * rays.T
            free = nearest(people, there)
            met |= (free < 1e-3) & (travelled < reach)
            travelled = (travelled + free.clamp(min=1e-3)).clamp(max=10)
        agree = met.reshape(SIZE, SIZE).numpy() == (shown == SHOWN)
        assert agree.mean() > 0.99  # rays that graze a figure for 1e-3 are met here


def nearest(parts: Parts, p: torch.Tensor) -> torch.Tensor:
    """The distance (R,) from points (3, R) to the nearest of some solids."""
    found = []
    for part in parts.values():
        c, s = math.cos(part.yaw), math.sin(part.yaw)
        turn = p.new_tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        found.append(part.shape.distance(turn @ (p - p.new_tensor(part.centre)[:, None])))
    return torch.stack(found).amin(0)


@pytest.mark.medium
@pytest.mark.parametrize("share", [0.1, pytest.param(0.2, marks=pytest.mark.slow), 0.4])
def test_distractors_cover_the_wanted_share(share: float) -> None:
    poses = courtyard_poses("train", 24, 1)
    covered = []
    for pose, people in zip(poses, crowds(poses, share, 1), strict=True):
        covered.append(float((visible_parts(pose, (100, 100), {**COURTYARD, **people})[1] >= len(COURTYARD)).mean()))
    print(
        f"wanted {share:.2f}: {np.mean(covered):.4f} on average, {min(covered):.2f} to {max(covered):.2f} in an image"
    )
    assert np.mean(covered) == pytest.approx(share, abs=0.01)
    assert min(covered) < 0.7 * share
    assert max(covered) > 1.3 * share


def test_the_same_figures_stand_elsewhere_in_each_image() -> None:
    found = crowds(courtyard_poses("train", 6, 2), 0.2, 2)
    again = crowds(courtyard_poses("train", 6, 2), 0.2, 2)
    places = [part.centre for people in found for part in people.values()]
    assert places == [part.centre for people in again for part in people.values()]
    assert len(set(places)) == len(places) > 6
    figures = [part.shape for part in cast(2)]
    assert all(part.shape in figures for people in found for part in people.values())
    for people in found:  # nobody stands in a wall or in the solids
        for part in people.values():
            axis = torch.tensor(part.centre, dtype=torch.float64)[:, None] + torch.tensor([[0.0], [0], [0.6]]).double()
            assert float(nearest(COURTYARD, axis).min()) > 0.15
    assert crowds(courtyard_poses("train", 3, 2), 0.0, 2) == [{}, {}, {}]


def test_light_changes_as_told() -> None:
    assert lights(5, Changing(), 1) == [DAYLIGHT] * 5
    everything = lights(200, Changing(True, True, True), 1)
    alone = lights(200, Changing(sun=True), 1)
    assert [lit.sun for lit in everything] == [lit.sun for lit in alone]
    assert all(lit.gains == (1.0, 1.0, 1.0) for lit in alone)
    gains = torch.tensor([lit.gains for lit in everything]).log2()
    assert 0.9 < gains[:, 1].abs().max() <= 1.0
    torch.testing.assert_close(gains[:, 0] + gains[:, 2], 2 * gains[:, 1])
    suns = torch.tensor([lit.sun for lit in everything])
    torch.testing.assert_close(suns.norm(dim=-1), torch.ones(200))


@pytest.mark.medium
def test_gains_multiply_the_light_of_a_pixel() -> None:
    """Display colours are sqrt(1 - exp(-1.35 light)): the inverse of an image's is the other's times its gains."""
    pose, gains = courtyard_poses("train", 1, 0)[0], (0.7, 0.9, 1.2)

    def light(lit: Light) -> np.ndarray:
        rgba = render_view(pose, CAMERA_ANGLE, 60, 60, supersample=1, geometry=False, parts=COURTYARD, lit=lit)[0]
        return -np.log(1 - np.clip(rgba[..., :3] / 255, 0, 0.999) ** 2)

    plain, changed = light(Light()), light(Light(gains=gains))
    usual = (plain > 0.1) & (plain < 2)
    for channel, gain in enumerate(gains):
        of_channel = usual[..., channel]
        ratio = changed[..., channel][of_channel] / plain[..., channel][of_channel]
        np.testing.assert_allclose(ratio, gain, rtol=0.04)  # of 8 bits


def test_a_union_is_its_members() -> None:
    members = ((Box((0.3, 0.2, 0.1)), (0.4, -0.1, 0.2)), (Sphere(0.25), (-0.3, 0.2, -0.1)))
    union = Union(members)
    generator = torch.Generator().manual_seed(0)
    p = torch.rand(3, 4000, generator=generator, dtype=torch.float64) * 2 - 1
    apart = torch.stack([shape.distance(p - p.new_tensor(centre)[:, None]) for shape, centre in members])
    torch.testing.assert_close(union.distance(p), apart.amin(0))
    assert float(p[:, union.distance(p) < 0].norm(dim=0).max()) < union.bound
    direction = torch.nn.functional.normalize(torch.randn(3, 4000, generator=generator, dtype=torch.float64), dim=0)
    offset = p - (p * direction).sum(0) * direction
    entry = union.enter(offset, direction, torch.full((4000,), -5.0).double())
    met = entry < math.inf
    assert 0.1 < met.double().mean() < 0.9
    at = offset + entry.nan_to_num(posinf=0.0) * direction
    assert float(union.distance(at)[met].abs().max()) < 1e-9
    before = torch.linspace(-5, 5, 400, dtype=torch.float64)[:, None]
    inside = union.distance((offset[:, None] + before * direction[:, None]).reshape(3, -1)).view(400, -1) < -1e-9
    assert not (inside & (before < entry)).any()
    step = 1e-6
    slopes = [union.distance(at[:, met] + step * axis[:, None]) / step for axis in torch.eye(3, dtype=torch.float64)]
    smooth = torch.stack(slopes).norm(dim=0) > 0.999  # off the box's edges
    torch.testing.assert_close(torch.stack(slopes)[:, smooth], union.normal(at[:, met])[:, smooth], atol=1e-4, rtol=0)
    lowest = union.distance((offset[:, None] + before * direction[:, None]).reshape(3, -1)).view(400, -1).amin(0)
    deepest = torch.stack([union.distance(offset + t * direction) for t in union.closest(offset, direction)]).amin(0)
    assert float((deepest - lowest)[met].max()) < 0.06  # inside a box, the middle is close to the deepest point


@pytest.mark.medium
def test_the_format_reads_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFLOOM_CACHE", str(tmp_path))
    flags = Procedural(size=16, num_train=4, courtyard=True, distractors=0.1, changing_white_balance=True)
    train, test = (load_dataset(flags.parse(None, split), split) for split in ("train", "test"))
    assert (len(train), len(test)) == (4, 16)
    assert train.scene.appearance_varies
    assert not train.scene.unbounded
    torch.testing.assert_close(train.scene.box, torch.tensor([[-HALF] * 3, [HALF] * 3]))
    assert len(list(tmp_path.iterdir())) == 1
    for wrong in (
        Procedural(distractors=0.1),
        Procedural(changing_sun=True),
        Procedural(courtyard=True, distractors=0.5),
        Procedural(courtyard=True, moving=True),
    ):
        with pytest.raises(DataError, match="--"):
            wrong.parse(None, "train")
