"""Pictures of levels: equal to pictures of all Gaussians at error 0, similar with fewer, within a limit of memory."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.levels.chunks import ChunkCache
from nerfloom.levels.drawn import DRAWN_SIZE, DrawnLevels
from nerfloom.levels.files import LevelsFile
from nerfloom.levels.settings import DetailSettings
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.transform import transformed
from tests.levels.made import FAR, all_around, built, camera, cloud, scene

BLACK = torch.zeros(3)
SAME = Placement.of(None, 1.0)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> LevelsFile:
    return built(tmp_path_factory.mktemp("levels") / "x.levels", cloud())


def drawn(
    file: LevelsFile, error: float, memory: float = 100.0, placement: Placement = SAME, given: Scene | None = None
) -> DrawnLevels:
    return DrawnLevels(file, placement, given or scene(), torch.device("cpu"), DetailSettings(error, memory))


@pytest.mark.parametrize("look", [OURS, Look(True, 0.1, "depth")])
@pytest.mark.parametrize("model", ["pinhole", "opencv", "fisheye"])
def test_error_0_is_the_picture_of_all_gaussians(tmp_path: Path, look: Look, model: str) -> None:
    """Without compiled kernels, sums of other lengths are rounded otherwise, and an edge may move by a pixel."""
    levels = drawn(built(tmp_path / "x.levels", cloud(), look=look), 0.0)
    plain = DrawnGaussians(cloud(), look, scene())
    for distance, turn in ((3.0, 0.0), (0.4, 0.8), (3.0, 0.4)):
        view = View(camera(distance, model, turn))
        found, expected = levels.render_view(view, BLACK), plain.render_view(view, BLACK)
        assert float(expected.accumulation.mean()) > 0.02
        for name in ("rgb", "accumulation", "depth", "median_depth", "normals"):
            away = (found.of(name) - expected.of(name)).abs()
            assert float((away > 1e-5).double().mean()) < 1e-3, name
        assert float((found.rgb - expected.rgb).abs().max()) < 2 / 255
        assert found.level_error == 0
        torch.testing.assert_close(levels.render_rgb(view, BLACK), found.rgb, atol=1e-6, rtol=0)


@pytest.mark.parametrize("look", [OURS, Look(sort="depth")])
@pytest.mark.parametrize("model", ["fisheye", "equirectangular"])
def test_what_is_behind_is_in_a_picture_of_all_directions(tmp_path: Path, look: Look, model: str) -> None:
    """Gaussians are sorted by distance, for all settings of training, from a place among them and one beside them."""
    levels = drawn(built(tmp_path / "x.levels", cloud(), look=look), 0.0)
    plain = DrawnGaussians(cloud(), look, scene())
    for distance in (0.3, 3.0):
        view = View(all_around(model, distance))
        found, expected = levels.render_view(view, BLACK), plain.render_view(view, BLACK)
        assert float(expected.accumulation.mean()) > 0.01
        for name in ("rgb", "accumulation"):
            assert float((found.of(name) - expected.of(name)).abs().mean()) < 1e-3, name


def test_frames_of_file_and_scene_may_differ(file: LevelsFile) -> None:
    """Turned, moved and scaled as a capture is placed: lengths are in scene units, normals in the scene's frame."""
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.1], [0.3, 0, 0.2], [-0.1, -0.2, 0]]).double())
    placement = Placement(torch.cat([turn, torch.tensor([[0.1], [-0.2], [0.05]]).double()], -1), 0.5)
    moved = transformed(cloud(), *placement.similarity())
    levels, plain = drawn(file, 0.0, placement=placement), DrawnGaussians(moved, OURS, scene())
    view = View(camera(2.0, turn=0.1))
    found, expected = levels.render_view(view, BLACK), plain.render_view(view, BLACK)
    for name in ("rgb", "accumulation", "depth", "median_depth", "normals"):
        away = (found.of(name) - expected.of(name)).abs()
        assert float(away.quantile(0.99)) < 1e-3, name
    assert float(found.median_depth.max()) == pytest.approx(FAR)


def test_a_coarse_picture_has_fewer_gaussians_and_about_the_same_colours(file: LevelsFile) -> None:
    view, fine = View(camera(6.0)), drawn(file, 0.0)
    exact = fine.render_view(view, BLACK)
    opaque = exact.accumulation > 0.9
    assert int(opaque.sum()) > 100
    before, numbers = 0.0, []
    for error in (1.0, 3.0, 10.0):
        levels = drawn(file, error)
        picture = levels.render_view(view, BLACK)
        numbers.append(int(file.nodes.counts[levels.cut(view).nodes].sum()))
        away = float((picture.rgb - exact.rgb)[opaque].abs().mean())
        print(f"level error {error:g}: {numbers[-1]} of {file.num_gaussians} Gaussians, colours off by {away:.3f}")
        assert away < 0.3
        assert away >= before / 2
        before = away
    assert file.num_gaussians >= numbers[0] >= numbers[1] > numbers[2]


def test_a_stride_keeps_pixels_as_they_are(file: LevelsFile) -> None:
    levels = drawn(file, 1.0)
    whole, some = (levels.render_view(View(camera(), stride=stride), BLACK).rgb for stride in (1, 3))
    assert torch.equal(some, whole[1::3, 1::3])


def test_memory_is_bounded_and_less_of_it_has_a_larger_error(
    file: LevelsFile, capsys: pytest.CaptureFixture[str]
) -> None:
    views = [View(camera(distance, turn=turn)) for distance in (0.5, 2.0, 6.0) for turn in (0.0, 0.5, 3.0)]
    errors = []
    for memory in (0.05, 0.2, 0.4, 10.0):
        levels, most = drawn(file, 0.5, memory), int(memory * 1e6 / (file.gaussian_size + DRAWN_SIZE))
        given = []
        for view in views:
            picture, cut = levels.render_view(view, BLACK), levels.cut(view)
            assert int(file.nodes.counts[cut.nodes].sum()) <= most
            assert levels.chunks.size <= file.gaussian_size * most <= memory * 1e6
            assert picture.level_error == cut.error >= 0.5
            given.append(cut.error)
        errors.append(given)
        said = " ".join(capsys.readouterr().err.split())
        assert ("has a level error of" in said) == (max(given) >= 0.75)
        assert said.count("has a level error of") <= 3 + math.log(max(given) / 0.5, 1.5)
    for more, less in zip(errors[1:], errors, strict=False):
        assert all(one <= other for one, other in zip(more, less, strict=True))
    assert errors[-1] == [0.5] * len(views)
    assert errors[0][0] > 0.5
    with pytest.raises(ConfigError, match=r"--memory-limit is 0\.001 MB"):
        drawn(file, 1.0, 0.001)


def test_nothing_in_view_is_background(file: LevelsFile) -> None:
    levels, background = drawn(file, 1.0), torch.tensor([0.2, 0.4, 0.6])
    picture = levels.render_view(View(camera(3.0, turn=math.pi)), background)
    torch.testing.assert_close(picture.rgb, background.expand(64, 64, 3))
    assert not picture.accumulation.any()
    torch.testing.assert_close(picture.depth, torch.full((64, 64), FAR))
    assert levels.chunks.size == 0


def test_chunks_that_were_used_last_stay() -> None:
    read = list[int]()

    def chunk(index: int) -> Gaussians:
        read.append(index)
        return cloud(index + 1)

    cache = ChunkCache(chunk, sizes=[10, 20, 30, 40], capacity=60)
    assert [len(part) for part in cache.chunks([0, 1, 2])] == [1, 2, 3]
    assert (read, cache.size) == ([0, 1, 2], 60)
    cache.chunks([2, 0])
    assert read == [0, 1, 2]
    cache.chunks([0, 3])  # 1 and 2 leave: neither is asked for
    assert (read, cache.size) == ([0, 1, 2, 3], 50)
    cache.chunks([1, 3])
    assert (read, cache.size) == ([0, 1, 2, 3, 1], 60)
    cache.chunks([])
    assert cache.size == 60


def test_settings_out_of_range_are_refused() -> None:
    for error, memory, flag in ((-1.0, 1.0, "--level-error"), (np.nan, 1.0, "--level-error"), (1.0, 0.0, "--memory")):
        with pytest.raises(FlagError, match=flag):
            DetailSettings(error, memory)
