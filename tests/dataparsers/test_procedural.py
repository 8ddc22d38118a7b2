"""The embedded scene: it is the truth of other tests, so it is held against independent truths here."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.procedural import Procedural, views
from nerfloom.dataparsers.procedural.random_scenes import MAX_REACH, random_parts, scene_numbers, write_scenes
from nerfloom.dataparsers.procedural.scene import LIGHT, PARTS, inside, trace, trace_rows
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE, camera_poses, render_view, write_dataset
from nerfloom.evaluation.evaluator import views_to_judge


def camera_rays(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from a sphere of radius 4 towards points near the origin, float64."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    origins[:, 2].abs_()
    origins = 4 * origins / origins.norm(dim=-1, keepdim=True)
    directions = (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5) * 2 - origins
    return origins, directions / directions.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("time", [0.0, 0.37])
def test_hits_lie_where_outside_turns_inside(time: float) -> None:
    origins, directions = camera_rays(20000)
    found = trace(origins, directions, time)
    hit = found.hit
    assert 0.3 < hit.double().mean() < 0.99
    before = origins[hit] + (found.depth[hit] - 1e-6)[:, None] * directions[hit]
    after = origins[hit] + (found.depth[hit] + 1e-6)[:, None] * directions[hit]
    grazing = (found.normals[hit] * directions[hit]).sum(-1).abs() < 1e-2
    assert not bool((inside(before, time) & ~grazing).any())
    assert bool((inside(after, time) | grazing).all())
    # Nothing solid is met on the way: random points in front of the hit, and anywhere on rays that miss.
    end = torch.where(hit, found.depth, torch.full_like(found.depth, 8.0))
    for share in torch.rand(20, generator=torch.Generator().manual_seed(1), dtype=torch.float64):
        on_the_way = origins + (share * (end - 1e-6))[:, None] * directions
        assert not bool(inside(on_the_way, time).any())


def test_normals_are_the_gradient_of_depth() -> None:
    """The plane through a hit, seen by a slightly turned ray, predicts that ray's depth to second order."""
    origins, directions = camera_rays(5000, seed=1)
    turned = directions + 1e-7 * torch.randn(5000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    turned = turned / turned.norm(dim=-1, keepdim=True)
    a, b = trace(origins, directions), trace(origins, turned)
    smooth = a.hit & b.hit & (a.part == b.part) & ((a.normals * b.normals).sum(-1) > 0.99)
    smooth &= (a.normals * directions).sum(-1) < -0.1
    plane = ((a.depth[:, None] * directions) * a.normals).sum(-1) / (turned * a.normals).sum(-1)
    error = (plane - b.depth)[smooth].abs().max().item()
    print(f"embedded scene: normals predict neighbouring depth to {error:.1e}")
    assert int(smooth.sum()) > 1500
    assert error < 1e-8


def test_a_ray_straight_down_on_the_ball() -> None:
    x, y, z = PARTS["ball"].centre
    found = trace(torch.tensor([[x, y, 5.0]], dtype=torch.float64), torch.tensor([[0, 0, -1.0]], dtype=torch.float64))
    assert found.depth.item() == pytest.approx(5 - z - 0.36, abs=1e-12)
    torch.testing.assert_close(found.normals, torch.tensor([[0, 0, 1.0]], dtype=torch.float64))
    assert list(PARTS)[int(found.part)] == "ball"


def seen_from(point: torch.Tensor, position: Sequence[float]) -> torch.Tensor:
    origin = torch.tensor([position], dtype=torch.float64)
    direction = point - origin
    hit = trace(origin, direction / direction.norm())
    torch.testing.assert_close(origin + hit.depth[:, None] * direction / direction.norm(), point, atol=1e-9, rtol=0)
    return hit.rgb[0]


def test_only_the_glossy_ball_looks_different_from_elsewhere() -> None:
    toward_sun = torch.tensor(LIGHT, dtype=torch.float64)
    ball = (torch.tensor(PARTS["ball"].centre, dtype=torch.float64) + 0.36 * toward_sun)[None]
    floor = torch.tensor([[0.25, -0.55, -0.45]], dtype=torch.float64)
    first = (ball[0] + 3 * toward_sun).tolist()  # looks straight into the highlight
    second = (-2.5, -0.5, 2.0)
    assert (seen_from(ball, first) - seen_from(ball, second)).abs().max() > 0.1
    torch.testing.assert_close(seen_from(floor, first), seen_from(floor, second), atol=1e-9, rtol=0)


def test_alpha_is_the_covered_share_of_the_pixel() -> None:
    pose = camera_poses("train", 5, 0)[2]
    coarse, depth, _ = render_view(pose, CAMERA_ANGLE, 24, 24, supersample=4)
    fine, _, _ = render_view(pose, CAMERA_ANGLE, 24 * 16, 24 * 16, supersample=1, geometry=False)
    truth = (fine[..., 3].reshape(24, 16, 24, 16) / 255).mean((1, 3))
    assert np.abs(coarse[..., 3] / 255 - truth).max() < 0.2  # 16 against 256 samples
    assert abs((coarse[..., 3] / 255).mean() - truth.mean()) < 0.003
    assert depth is not None
    assert (np.isfinite(depth) == (truth > 0.5))[np.abs(truth - 0.5) > 0.45].all()


def test_everything_is_inside_the_box() -> None:
    points = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0)) * 6 - 3
    for time in (0.0, 0.25, 0.5, 1.0):
        solid = points[inside(points, time)]
        assert len(solid) > 100
        assert solid.abs().max() < 1.4


def folder_bytes(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_the_data_set_is_complete_and_repeats(tmp_path: Path) -> None:
    counts = {"train": 3, "val": 1, "test": 2}
    for name in ("a", "b"):
        write_dataset(tmp_path / name, size=16, counts=counts, moving=True, seed=5)
    first, second = folder_bytes(tmp_path / "a"), folder_bytes(tmp_path / "b")
    assert first.keys() == second.keys()
    assert {name for name in first if first[name] != second[name] and not name.endswith(".npz")} == set()
    frames = json.loads(first["transforms_train.json"])["frames"]
    assert [frame["time"] for frame in frames] == [0, 0.5, 1]
    assert iio.imread(tmp_path / "a" / "train" / "r_000.png").shape == (16, 16, 4)
    with np.load(tmp_path / "a" / "test" / "r_001_geometry.npz") as geometry:
        assert geometry["depth"].shape == (16, 16)
        assert geometry["normals"].shape == (16, 16, 3)
    assert not list(tmp_path.glob(".*"))


def test_the_moving_scene_starts_as_the_standing_one() -> None:
    pose = camera_poses("test", 4, 0)[1]
    still, start, later = (render_view(pose, CAMERA_ANGLE, 32, 32, t, geometry=False)[0] for t in (0.0, 0.0, 0.5))
    np.testing.assert_array_equal(still, start)
    assert (start != later).any(-1).mean() > 0.02


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(jobs: object, title: str, total: int) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr(views, "track", stop)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(tmp_path / "scene", size=8, counts={"train": 2})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.medium
def test_the_parser_renders_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFLOOM_CACHE", str(tmp_path))
    parsed = Procedural(size=8, num_train=2).parse(None, "train")
    stamp = parsed.image_paths[0].stat().st_mtime_ns
    again = Procedural(size=8, num_train=2).parse(None, "train")
    assert again.image_paths[0].stat().st_mtime_ns == stamp
    assert math.isclose(again.cameras.fx[0].item(), 4 / math.tan(CAMERA_ANGLE / 2), rel_tol=1e-6)


# -- many scenes -------------------------------------------------------------------------------------------------------


def test_random_solids_fit_into_the_box_and_differ_between_scenes() -> None:
    found = [random_parts(0, scene) for scene in range(200)]
    assert {len(parts) for parts in found} == {2, 3, 4, 5}
    solids = [part for parts in found for part in parts.values()]
    assert {type(part.shape).__name__ for part in solids} == {"Sphere", "Box"}
    assert max(math.hypot(*part.centre) + part.shape.bound for part in solids) <= MAX_REACH
    centres = torch.tensor([part.centre for part in solids])
    assert len(centres.unique(dim=0)) == len(centres)
    assert centres.mean(0).abs().max() < 0.1
    assert [part.centre for part in random_parts(0, 7).values()] == [part.centre for part in found[7].values()]
    assert [part.centre for part in random_parts(1, 7).values()] != [part.centre for part in found[7].values()]


def test_a_random_solid_has_its_own_colour_and_no_other() -> None:
    """The middle of an image shows the nearest solid on the axis: its albedo's hue, shaded."""
    parts = random_parts(0, 3)
    origins, directions = camera_rays(4000, seed=2)
    found = trace_rows(origins.T.contiguous(), directions.T.contiguous(), 0.0, parts=parts)
    hit = found.depth.isfinite()
    places = origins[hit] + found.depth[hit][:, None] * directions[hit]
    distances = torch.stack(
        [
            p.shape.distance(turned(places - torch.tensor(p.centre, dtype=torch.float64), -p.yaw).T)
            for p in parts.values()
        ]
    )
    assert 0.05 < hit.double().mean() < 0.9
    assert distances.abs().amin(0).max() < 1e-9  # a hit lies on the surface of a solid
    assert distances.min() > -1e-9  # and in none
    assert torch.equal(distances.abs().argmin(0), found.part[hit])


def turned(points: torch.Tensor, yaw: float) -> torch.Tensor:
    """Points (N, 3), turned around z."""
    turn = torch.tensor(
        [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]], dtype=torch.float64
    )
    return points @ turn.T


def test_no_scene_is_in_two_splits() -> None:
    numbers = [number for split in ("train", "val", "test") for number in scene_numbers(split, 5)]
    assert sorted(numbers) == list(range(5 + 4 + 8))


@pytest.mark.medium
def test_many_scenes_are_kept_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each image equals tracing the solids of its scene along its own rays."""
    monkeypatch.setenv("NERFLOOM_CACHE", str(tmp_path))
    parser = Procedural(size=16, num_scenes=3, views_per_scene=4)
    train, test = (load_dataset(parser.parse(None, split), split) for split in ("train", "test"))
    assert train.scene_indices is not None
    assert test.scene_indices is not None
    assert train.scene_indices.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert test.scene_indices.tolist() == [number for number in range(7, 15) for _ in range(4)]
    assert (train.scene.num_scenes, test.scene.num_scenes) == (3, 8)
    assert train.source_images is None
    assert views_to_judge(train) == list(range(12))
    assert views_to_judge(test) == list(range(3, 32, 4))
    assert [test.view(index).scene for index in (0, 3, 4)] == [7, 7, 8]
    for data, index in ((train, 5), (train, 11), (test, 30)):
        scene = int(data.scene_indices[index])  # type: ignore[index]
        rays = data.cameras.pixel_rays(data.cameras.image_pixels(index), 0.0, 9.0)
        shown = [trace_rows(rays.origins.T, rays.directions.T, 0.0, parts=random_parts(0, n)) for n in (scene, 1)]
        alpha = data.image(index)[..., 3].reshape(-1)
        clear = (alpha == 0) | (alpha == 255)
        assert torch.equal((alpha > 0)[clear], shown[0].hit[clear])
        assert scene == 1 or not torch.equal((alpha > 0)[clear], shown[1].hit[clear])


@pytest.mark.medium
def test_some_images_of_many_scenes_know_theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFLOOM_CACHE", str(tmp_path))
    parser = Procedural(size=8, num_scenes=2, views_per_scene=5)
    parsed = parser.parse(None, "val")
    some = parsed[torch.tensor([9, 0, 3])]
    assert some.scene_indices is not None
    assert some.source_images is not None
    assert (some.scene_indices.tolist(), some.source_images.tolist()) == ([3, 2, 2], [True, True, False])
    parsed.image_paths[0].unlink()  # one that is missing moves no other into another scene
    left = parser.parse(None, "val")
    assert left.scene_indices is not None
    assert left.scene_indices.tolist() == [2] * 4 + [number for number in (3, 4, 5) for _ in range(5)]


@pytest.mark.medium
def test_many_scenes_repeat_with_the_seed(tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        write_scenes(tmp_path / name, size=8, num_scenes=2, views=4, seed=seed)
    first, second, other = (folder_bytes(tmp_path / name) for name in "abc")
    assert first == second
    assert first.keys() == other.keys()
    assert all(first[name] != other[name] for name in first)
    assert len(first) == 3 + 4 * (2 + 4 + 8)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"num_scenes": 0}, "--num-scenes must be at least 1"),
        ({"num_scenes": 2, "views_per_scene": 3}, "--views-per-scene at least 4"),
        ({"num_scenes": 2, "moving": True}, "leave out --num-scenes or --moving"),
        ({"scene_seed": -1}, "--scene-seed is -1; it must be at least 0"),
    ],
)
def test_scenes_that_cannot_be_made_are_refused(settings: dict[str, int], said: str) -> None:
    with pytest.raises(DataError, match=said):
        Procedural(**settings).parse(None, "train")  # type: ignore[arg-type]
