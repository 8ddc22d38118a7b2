"""Baking: cells against closed forms, harmonics against numpy's least squares, and a run against its octree."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import nerfloom
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import Placement
from nerfloom.cli.bake import main
from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene
from nerfloom.evaluation.metrics import psnr
from nerfloom.export.bake import Baking, bake
from nerfloom.export.octree_cells import OPAQUE, MatterSearch
from nerfloom.export.octree_colors import fitted
from nerfloom.export.page_scenes import octree_page
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import raw_of
from nerfloom.kernels.octree.weights import raise_weights
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.files import read_octree, write_octree
from nerfloom.octrees.grid import Grid
from nerfloom.ray_model import RayModel
from nerfloom.registry import load_method
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.testing.ball import RADIUS as BALL_RADIUS
from nerfloom.testing.scenes import ball_under_a_sky
from tests.cli.helpers import TINY_NGP, called
from tests.conftest import Refused
from tests.octrees.balls import ball

RADIUS, SIGMA = 0.4, 50.0
BOX = torch.tensor([[-1.0, -1.5, -1.0], [1.0, 1.0, 2.0]])


class Ball:
    """A model with a known density."""

    scene = Scene(box=BOX, near=0.1, far=9.0, num_cameras=1, has_alpha=True, moving=False, image_size=40)
    device = torch.device("cpu")

    def __init__(self) -> None:
        self.asked = 0

    def rendering(self):
        from contextlib import nullcontext

        return nullcontext()

    def density(self, points: Points) -> Tensor:
        self.asked += len(points.positions)
        return SIGMA * (points.positions.norm(dim=-1) < RADIUS).float()


def test_the_box_fits_the_matter_and_cells_fill_it() -> None:
    model = Ball()
    search = MatterSearch(model)
    grid = search.tight(64)
    low, high = grid.origin, grid.origin + 8 * grid.cell * torch.tensor(grid.size)
    assert bool((low <= -RADIUS).all()) and bool((high >= RADIUS).all())  # noqa: PT018
    assert float((high - low).max()) < 2.6 * RADIUS + 16 * grid.cell
    cells, depths = search.cells(grid)
    volume = len(cells) * grid.cell**3
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)
    torch.testing.assert_close(depths, torch.full_like(depths, SIGMA * grid.cell))
    assert float(grid.positions(cells + 0.5).norm(dim=-1).max()) < RADIUS


class Slope(Ball):
    """A density that rises along x; with a wall, it is 0 up to x = 0."""

    def __init__(self, wall: bool) -> None:
        super().__init__()
        self.wall = wall

    def density(self, points: Points) -> Tensor:
        x = points.positions[:, 0]
        return SIGMA * (x > 0).float() if self.wall else SIGMA * (x + 1)


def test_a_leaf_has_the_depth_of_its_eighths() -> None:
    """Along a slope the depth is that of the centre; of a wall that fills half of a leaf, it is that of the half."""
    cells = torch.cartesian_prod(*[torch.arange(8)] * 3)
    layout, _ = OctreeLayout.build(torch.tensor([-0.35, -0.4, -0.4]), 0.1, (1, 1, 1), cells)
    centers = layout.centers()
    depths, places = MatterSearch(Slope(wall=False)).averaged(layout, torch.zeros(512))
    torch.testing.assert_close(depths, 0.1 * SIGMA * (centers[:, 0] + 1))
    assert bool((places[:, 0] > centers[:, 0]).all())
    torch.testing.assert_close(places[:, 1:], centers[:, 1:])
    sky = torch.where(torch.arange(512) < 5, OPAQUE, 1.0)
    depths, places = MatterSearch(Slope(wall=True)).averaged(layout, sky)
    assert depths[:5].tolist() == [OPAQUE] * 5
    half = centers[:, 0].abs() < 0.01
    torch.testing.assert_close(depths[half & (sky == 1)], torch.full((int((half & (sky == 1)).sum()),), SIGMA * 0.05))
    torch.testing.assert_close(places[half, 0], torch.full((int(half.sum()),), 0.025), atol=1e-4, rtol=0)
    empty = (centers[:, 0] < -0.01) & (sky == 1)
    assert float(depths[empty].max()) == pytest.approx(0.01)


class Skipping(nn.Module):
    """A model with an occupancy grid, dense everywhere."""

    scene = replace(Ball.scene, box=torch.tensor([[-1.0] * 3, [1.0] * 3]))
    device = torch.device("cpu")

    def __init__(self, grid: OccupancySampler) -> None:
        super().__init__()
        self.grid = grid

    def density(self, points: Points) -> Tensor:
        return torch.ones(len(points.positions))


def test_octants_are_those_that_an_occupied_cell_overlaps() -> None:
    """Cells of the occupancy grid are an octant's 16th along each axis."""
    occupancy, cells = OccupancySampler(Skipping.scene.box, resolution=64), [(5, 6, 7), (20, 40, 61), (33, 17, 50)]
    occupancy.occupied.zero_()
    for x, y, z in cells:
        occupancy.occupied[(x * 64 + y) * 64 + z] = True
    low, high = Skipping.scene.box.double()
    found = MatterSearch(Skipping(occupancy)).octants(Grid.of(low, high, 16))
    assert found.tolist() == [[x // 16, y // 16, z // 16] for x, y, z in sorted(cells)]


class World(Ball):
    """The ball and a larger one, centred five units away: in the third and the fourth of boxes around one another."""

    def __init__(self, has_alpha: bool) -> None:
        super().__init__()
        self.scene = replace(Skipping.scene, unbounded=True, has_alpha=has_alpha, far=1000.0)

    def density(self, points: Points) -> Tensor:
        away = (points.positions - torch.tensor([5.0, 0.0, 0.0])).norm(dim=-1) < 2
        return super().density(points) + SIGMA * away.float()


def test_boxes_around_one_another_hold_the_matter_once() -> None:
    search = MatterSearch(World(has_alpha=True))
    grids = search.grids(32)
    assert [grid.cell for grid in grids] == [2 / 32, 4 / 32, 8 / 32, 16 / 32]
    layout, depths = search.layout(grids)
    edges = layout.edges_of(torch.arange(layout.num_leaves), torch.float32)
    torch.testing.assert_close(depths, SIGMA * edges)
    assert float(edges.pow(3).sum()) == pytest.approx(4 / 3 * np.pi * (RADIUS**3 + 2**3), rel=0.1)
    for number, level in enumerate(layout.levels):
        farthest = level.within([]).centers().abs().amax(-1)
        assert bool((farthest < 2.0**number).all())
        assert number == 0 or bool((farthest > 2.0 ** (number - 1)).all())


def test_no_ray_leaves_an_unbounded_scene_without_alpha() -> None:
    torch.manual_seed(0)
    search = MatterSearch(World(has_alpha=False))
    layout, depths = search.layout(search.grids(32))
    assert int((depths == OPAQUE).sum()) == 32**3 - 30**3
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    rays = Rays(torch.rand(500, 3) * 2 - 1, directions)
    opacity = raise_weights(layout, raw_of(depths)[:, None], rays, torch.zeros(len(depths)))
    torch.testing.assert_close(opacity, torch.ones(500))


class Painted(Field):
    """A ball with the colours of `ball_under_a_sky`, and its sky."""

    unbounded = True

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        return SIGMA * (points.positions.norm(dim=-1) < BALL_RADIUS).float(), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        distance = features.norm(dim=-1, keepdim=True)
        return 0.5 + 0.4 * torch.where(distance < 1, features / distance.clamp(min=1e-6), directions)


@pytest.mark.medium
def test_a_capture_is_baked_without_holes(tmp_path: Path) -> None:
    dataset, method = ball_under_a_sky(), load_method("nerfacto")
    model = replace(method, field=lambda config, scene: Painted()).build(method.config, dataset.scene).eval()
    loaded = SimpleNamespace(
        model=model,
        method="painted",
        run=SimpleNamespace(config=replace(method.config, robust="off")),
        dataset=lambda split: dataset,
        input_placement=Placement.of(torch.eye(3, 4), 1.0),
    )
    truth = torch.stack([dataset.image(index) for index in range(len(dataset))]) / 255
    found = []
    for seconds in (0.0, 1.0):
        octree = bake(loaded, Baking(resolution=32, degree=1, seconds=seconds))
        write_octree(tmp_path / "x.octree", octree)
        drawn = DrawnOctree(read_octree(tmp_path / "x.octree"), dataset.scene)
        assert len(octree.layout.levels) == 4
        pictures = [drawn.render_view(dataset.view(index), torch.zeros(3)) for index in range(len(dataset))]
        assert min(float(picture.accumulation.min()) for picture in pictures) > 0.99
        found.append(psnr(torch.stack([picture.rgb for picture in pictures]), truth))
    print(f"PSNR {found[0]:.1f} dB, and {found[1]:.1f} dB after learning")
    assert found[0] > 18  # a grey picture has 12 dB
    assert found[1] > found[0] - 0.5
    with pytest.raises(ConfigError, match="--kind gaussians"):
        octree_page(loaded, octree, dataset.cameras, None, torch.eye(3), 30.0, ())


class FromImages(RayModel):
    """A model that has no field without images."""

    def show_images(self, dataset: Dataset) -> None:
        raise NotImplementedError


def test_a_model_that_renders_from_images_has_nothing_to_bake() -> None:
    loaded = SimpleNamespace(model=FromImages.__new__(FromImages), method="pixel-nerf")
    with pytest.raises(ConfigError, match="pixel-nerf cannot be baked: it renders from images"):
        bake(loaded, Baking())


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_harmonics_are_fitted_as_by_numpy(degree: int) -> None:
    torch.manual_seed(degree)
    directions = torch.nn.functional.normalize(torch.randn(5, 30, 3), dim=-1)
    colors, weights = torch.rand(5, 30, 3), torch.rand(5, 30)
    found = fitted(directions, colors, weights, degree).view(5, 3, -1)
    for leaf in range(5):
        basis = spherical_harmonics(directions[leaf].contiguous(), degree + 1).double().numpy()
        share = np.sqrt(weights[leaf].double().numpy() / weights[leaf].double().sum().item())[:, None]
        ridge = np.sqrt(0.03) * np.eye(basis.shape[1])[1:]
        left = np.concatenate([share * basis, ridge])
        right = np.concatenate([share * colors[leaf].double().numpy(), np.zeros((len(ridge), 3))])
        truth = np.linalg.lstsq(left, right, rcond=None)[0]
        np.testing.assert_allclose(found[leaf].T.numpy(), truth, atol=1e-4)


@pytest.mark.slow
def test_a_run_and_its_octree(shared_tiny: Path, tmp_path: Path) -> None:
    words = ("--data", shared_tiny, "--output-dir", tmp_path, "--timestamp", "run", "--max-num-iterations", 400)
    done = called("ns-train", "instant-ngp", *words, *TINY_NGP)
    assert done.returncode == 0, done.stderr
    (config,) = tmp_path.rglob("config.yml")
    file = tmp_path / "x.octree"
    flags = ("--output-path", file, "--resolution", 48, "--fine-tune-seconds", 3, "--max-megabytes", 2)
    done = called("ns-bake", config.parent, *flags)
    assert done.returncode == 0, done.stderr
    assert file.stat().st_size < 2e6
    run, octree = nerfloom.load(config.parent), nerfloom.load(file, data=shared_tiny)
    teacher, student = run.evaluate()["psnr"], octree.evaluate()["psnr"]
    print(f"run {teacher:.2f} dB, octree {student:.2f} dB")
    assert student > teacher - 1.5
    done = called("ns-eval", file, "--data", shared_tiny)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "x.eval.json").is_file()
    done = called("ns-bake", config.parent, *flags[:2], "--resolution", 48, "--fine-tune-seconds", 0, "--degree", 1)
    assert done.returncode == 0, done.stderr
    assert read_octree(file).leaves.colors.shape[1] == 12
    other = replace(run, model=replace_scene(run.model))
    with pytest.raises(ConfigError, match="beyond its box"):
        bake(other, Baking())


def replace_scene(model):
    model.scene = replace(model.scene, unbounded=True)
    return model


def test_a_file_of_an_octree_is_not_replaced_by_what_is_left_of_it(tmp_path: Path, refused: Refused) -> None:
    """Its values are rounded again, to fewer bits."""
    file, smaller = tmp_path / "scene.octree", tmp_path / "smaller.octree"
    write_octree(file, ball())
    before = file.read_bytes()
    assert "name another file: --output-path" in refused(main, file, status=2)
    assert file.read_bytes() == before
    done = called("ns-bake", file, "--output-path", smaller)
    assert done.returncode == 0, done.stderr
    found, given = read_octree(smaller), ball()
    assert found.layout.num_leaves == given.layout.num_leaves
    assert (found.far, found.has_alpha, found.image_size) == (given.far, given.has_alpha, given.image_size)
    torch.testing.assert_close(found.leaves.coefficients(), given.leaves.coefficients(), atol=0.05, rtol=0)
    assert smaller.stat().st_size <= len(before)


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--resolution", 8), "--resolution"),
        (("--degree", 4), "--degree"),
        (("--max-megabytes", 0), "--max-megabytes"),
        (("--max-megabytes", "inf"), "--max-megabytes"),
        (("--fine-tune-seconds", -1), "--fine-tune-seconds"),
        (("--fine-tune-seconds", "inf"), "--fine-tune-seconds"),
        (("--output-path", "x.ply"), ".octree"),
    ],
)
def test_flags_that_cannot_be(flags: tuple[object, ...], named: str, tmp_path: Path) -> None:
    done = called("ns-bake", tmp_path, *flags)
    assert done.returncode == 2
    assert named in done.stderr
    assert len(done.stderr.splitlines()) == 1
