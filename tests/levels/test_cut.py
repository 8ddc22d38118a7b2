"""Cuts of a tree: compared with a walk from the root, with budgets, and with the rasteriser's pictures."""

import pytest
import torch

from nerfloom.kernels.splats.project import Record
from nerfloom.levels.cut import cut_of
from nerfloom.levels.files import LevelsFile
from nerfloom.levels.nodes import Nodes
from nerfloom.levels.on_image import in_view, sizes_on_image, tangents
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.rasteriser import RASTERISER
from tests.levels.made import all_around, built, camera, cloud, leaves

ALL = 10**9
CAMERAS = [
    camera(3.0),
    camera(0.5, turn=0.7),
    camera(30.0),
    camera(1.2, "opencv", turn=0.3),
    camera(0.8, "fisheye", turn=-0.4),
    camera(3.0, turn=3.1),
    all_around("equirectangular", 0.5),
    all_around("fisheye", 0.5),
]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> LevelsFile:
    return built(tmp_path_factory.mktemp("levels") / "x.levels", cloud())


def walk(nodes: Nodes, sizes: torch.Tensor, seen: torch.Tensor, error: float) -> list[int]:
    """The cut, by its definition."""
    found, waiting = [], [len(nodes) - 1]
    while waiting:
        index = waiting.pop()
        below = (nodes.parents == index).nonzero()[:, 0].tolist()
        if bool(seen[index]) and (not below or float(sizes[index]) <= error):
            found.append(index)
        elif bool(seen[index]):
            waiting += below
    return sorted(found)


@pytest.mark.parametrize("number", range(len(CAMERAS)))
def test_the_cut_is_that_of_a_walk_from_the_root(file: LevelsFile, number: int) -> None:
    drawn = splat_camera(CAMERAS[number], 0.01)
    sizes = sizes_on_image(file.nodes, drawn, 0.01)
    seen = in_view(file.nodes.boxes, drawn, tangents(CAMERAS[number], drawn.blur))
    for error in (0.0, 0.3, 1.0, 3.0, 30.0, 1e6):
        found = cut_of(file.nodes, sizes, seen, error, ALL)
        assert found.error == error
        assert found.nodes == walk(file.nodes, sizes, seen, error)


def test_error_0_has_all_leaves(file: LevelsFile) -> None:
    everything = torch.ones(len(file.nodes), dtype=torch.bool)
    sizes = sizes_on_image(file.nodes, splat_camera(CAMERAS[0], 0.01), 0.01)
    found = cut_of(file.nodes, sizes, everything, 0.0, ALL)
    assert found.nodes == leaves(file)
    assert int(file.nodes.counts[found.nodes].sum()) == 3000
    assert cut_of(file.nodes, sizes, everything, 1e9, ALL).nodes == [len(file.nodes) - 1]
    assert cut_of(file.nodes, sizes, ~everything, 1.0, ALL).nodes == []


def test_less_memory_never_has_a_smaller_error(file: LevelsFile) -> None:
    everything = torch.ones(len(file.nodes), dtype=torch.bool)
    for seen_from in CAMERAS[:3]:
        sizes = sizes_on_image(file.nodes, splat_camera(seen_from, 0.01), 0.01)
        errors = []
        for most in (100, 150, 300, 700, 1500, 3000):
            found = cut_of(file.nodes, sizes, everything, 0.0, most)
            assert int(file.nodes.counts[found.nodes].sum()) <= most
            assert found.nodes == walk(file.nodes, sizes, everything, found.error)
            errors.append(found.error)
        assert errors == sorted(errors, reverse=True)
        assert errors[0] > errors[-1] == 0


@pytest.mark.parametrize("number", range(len(CAMERAS)))
def test_nothing_that_is_drawn_is_left_out(file: LevelsFile, number: int) -> None:
    drawn = splat_camera(CAMERAS[number], 0.01)
    seen = in_view(file.nodes.boxes, drawn, tangents(CAMERAS[number], drawn.blur))
    visible = [
        bool((RASTERISER.project(file.read(index), drawn).records[:, Record.CUT] > 0).any())
        for index in range(len(file.nodes))
    ]
    assert not (torch.tensor(visible) & ~seen).any()
    above = file.nodes.of_parents(seen.long(), 1).bool()
    assert bool((above | ~seen).all())  # nodes above a visible node are visible
    print(f"{int(seen.sum())} of {len(seen)} nodes may be seen, {sum(visible)} are")


def test_what_is_beside_or_behind_is_left_out(file: LevelsFile) -> None:
    away = camera(3.0, turn=torch.pi)
    drawn = splat_camera(away, 0.01)
    assert not in_view(file.nodes.boxes, drawn, tangents(away, drawn.blur)).any()
    narrow = camera(30.0, turn=0.3)  # 17 degrees beside, and half of an image are 27
    assert in_view(file.nodes.boxes, splat_camera(narrow, 0.01), tangents(narrow, 0.3)).any()
    beside = camera(30.0, turn=0.8)
    assert not in_view(file.nodes.boxes, splat_camera(beside, 0.01), tangents(beside, 0.3)).any()


def test_errors_on_the_image() -> None:
    """A length of 0.1 is 0.1 f / d pixels at distance d; the camera is 2 in front of the box, or in it."""
    box = torch.tensor([[1.0, 1.0, 1.0]], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    nodes = Nodes(torch.tensor([5]), torch.tensor([-1]), -box, box, one, 0.1 * one)
    assert float(sizes_on_image(nodes, splat_camera(camera(3.0), 0.01), 0.01)) == pytest.approx(0.1 * 64 / 2)
    assert float(sizes_on_image(nodes, splat_camera(camera(0.5), 0.01), 0.25)) == pytest.approx(0.1 * 64 / 0.25)


def test_directions_of_a_pinhole() -> None:
    found = tangents(camera(size=64), 0.0)
    expected = torch.tensor([[-0.52, -0.52], [0.52, 0.52]], dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
