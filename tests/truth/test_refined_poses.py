"""With refined poses, everything is in the frame of the learnt scene: a ball with given poses that are off."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.cameras.rigid_motion import rigid_motions
from nerfloom.data.dataset import Dataset
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.pixels.batch import draw_batch
from nerfloom.data.scene import Scene
from nerfloom.evaluation.evaluator import measure_view
from nerfloom.export.cameras import camera_list, posed_files
from nerfloom.export.colors import seen_colors
from nerfloom.export.lattice import lattice_of
from nerfloom.export.meshing import fused_mesh, level_set_mesh
from nerfloom.export.points import joined, picture_points, surface_points
from nerfloom.export.settings import MarchingCubesSettings, TsdfSettings
from nerfloom.geometry.points import Points
from nerfloom.renderable import training_poses
from nerfloom.testing.ball import RADIUS
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.loaded import Loaded
from tests.exact_ball import ExactBall, colors_of
from tests.training.helpers import tiny_trainer

MOTION = torch.tensor([0.3, -0.2, 0.4, 0.1, -0.2, 0.15])
"""The motion that the data's cameras lack, a screw about the origin (`rigid_motions`)."""
SIZE = 90
"""Width and height of the images, pixels."""


class LearntBall(ExactBall):
    """A ball that was learnt with one motion of all training cameras."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        assert scene.camera_to_worlds is not None
        self.poses = PoseRefinement(scene.num_cameras, "SE3", scene.camera_to_worlds)
        self.poses.tangents.data[:] = MOTION

    def refined_poses(self, poses: Tensor, training: bool) -> Tensor:
        return self.poses.refined(poses, training)

    def density(self, points: Points) -> Tensor:
        """Half of the largest density is on the ball."""
        return 1e4 * (RADIUS + 0.05 - points.positions.norm(dim=-1)).clamp(0, 0.1)


def moved_back(poses: Tensor) -> Tensor:
    """Poses (M, 3, 4) that the motion maps to the given ones."""
    motion = rigid_motions(MOTION[None].double(), True)[0]
    turn, shift = motion[:, :3].T, motion[:, 3]
    found = poses.double().clone()
    found[:, :, 3] -= shift
    return (turn @ found).float()


@pytest.fixture
def true() -> Dataset:
    """Images with the cameras that took them."""
    return replace(ball_in_a_box(SIZE), training=True)


@pytest.fixture
def loaded(true: Dataset, monkeypatch: pytest.MonkeyPatch) -> Loaded:
    """A run on the same images, with cameras elsewhere in the data."""
    wrong = moved_back(true.cameras.camera_to_worlds)
    assert float((wrong - true.cameras.camera_to_worlds).abs().max()) > 0.5
    cameras = replace(true.cameras, camera_to_worlds=wrong)
    scene = replace(true.scene, camera_to_worlds=wrong)
    given = replace(true, cameras=cameras, scene=scene)
    files = tuple(Path("images") / name for name in true.names)

    def load_split(run: Any, split: str) -> Dataset:
        return replace(given, training=split == "train")

    def parse(split: str) -> ParsedScene:
        if split == "val":
            raise DataError("no such images")
        return ParsedScene(files, cameras, scene.box, scene.near, scene.far)

    monkeypatch.setattr("nerfloom.training.loaded.load_split", load_split)
    source: Any = SimpleNamespace(parse=parse)
    return Loaded(LearntBall(scene), Placement.of(None, 1.0), "ball", Path("run"), Path("run/step"), source=source)


def model_of(loaded: Loaded) -> LearntBall:
    assert isinstance(loaded.model, LearntBall)
    return loaded.model


def assert_true(cameras: Cameras, true: Dataset) -> None:
    torch.testing.assert_close(cameras.camera_to_worlds, true.cameras.camera_to_worlds, atol=1e-5, rtol=0)


def test_cameras_stand_where_the_images_were_taken(loaded: Loaded, true: Dataset) -> None:
    """Training cameras have their own motion, and others follow the training cameras around them."""
    for split in ("train", "test"):
        assert_true(loaded.dataset(split).cameras, true)  # type: ignore[arg-type]
        assert_true(loaded.parsed(split).cameras, true)  # type: ignore[arg-type]
        psnr = measure_view(loaded.model, loaded.dataset(split), 2, torch.ones(3)).psnr  # type: ignore[arg-type]
        assert psnr > 30
    assert (
        measure_view(loaded.model, replace(true, cameras=loaded.run.parse("train").cameras), 2, torch.ones(3)).psnr < 20
    )
    known = training_poses(loaded.model)
    assert known is not None
    torch.testing.assert_close(known, true.cameras.camera_to_worlds, atol=1e-5, rtol=0)


def test_exported_cameras_stand_there_too(loaded: Loaded, true: Dataset) -> None:
    dataset, scenes = loaded.dataset("train"), {"train": loaded.parsed("train")}
    listed = camera_list(dataset.cameras, dataset.names, loaded.placement)
    expected = true.cameras.camera_to_worlds
    torch.testing.assert_close(torch.tensor([row["transform"] for row in listed]), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(posed_files(scenes, loaded.placement).poses.float(), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("casts_rays", [True, False])
def test_points_lie_on_the_ball(casts_rays: bool, loaded: Loaded) -> None:
    torch.manual_seed(0)
    points = surface_points if casts_rays else picture_points
    found = joined(points(model_of(loaded), loaded.dataset("train"), 2_000, None))
    assert len(found.positions) > 200
    radii = found.positions.norm(dim=-1)
    torch.testing.assert_close(radii, torch.full_like(radii, RADIUS), atol=1e-4, rtol=0)
    torch.testing.assert_close(found.colors, colors_of(found.positions / RADIUS), atol=1e-3, rtol=0)


def test_vertices_have_the_colours_of_their_places(loaded: Loaded) -> None:
    normals = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    found = seen_colors(model_of(loaded), RADIUS * normals, normals, 0.05, 0.0)
    torch.testing.assert_close(found, colors_of(normals), atol=1e-4, rtol=0)


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["density", "depth"])
def test_meshes_lie_on_the_ball(kind: str, loaded: Loaded) -> None:
    pytest.importorskip("skimage")
    model, dataset = model_of(loaded), loaded.dataset("train")
    lattice = lattice_of(model.scene.box, 40)
    if kind == "density":
        mesh = level_set_mesh(model, lattice, dataset.cameras, MarchingCubesSettings(isosurface_threshold=500.0))
    else:
        mesh = fused_mesh(model, dataset, lattice, TsdfSettings())
    assert mesh.colors is not None
    radii = mesh.vertices.norm(dim=-1)
    off = (radii - RADIUS).abs().mean() / lattice.spacing
    wrong = (mesh.colors - colors_of(mesh.vertices.float() / radii.float()[:, None])).abs().mean()
    print(f"{kind}: {float(off):.3f} cells, colours by {float(wrong):.4f}")
    assert off < 0.3
    assert wrong < 0.03


def test_lengths_are_those_of_the_ball(loaded: Loaded, true: Dataset) -> None:
    """The length is between the middles of two photographs, which show the nearest places to the cameras."""
    ends = []
    for index in (1, 3):
        end = loaded.pick(loaded.dataset("train").view(index), SIZE / 2 - 0.5, SIZE / 2 - 0.5)
        place = true.cameras.camera_to_worlds[index, :, 3]
        torch.testing.assert_close(end.float(), RADIUS * place / place.norm(), atol=1e-3, rtol=0)
        ends.append(end)
    found = loaded.measure(*ends)
    assert found.value == pytest.approx(float((ends[0] - ends[1]).norm()))


def test_training_moves_rays_and_rendering_does_not(shared_tiny: Path, tmp_path: Path) -> None:
    """A loss uses rays from the refined cameras; rendered rays are in the scene's frame already."""
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path / "run", sampler="proposal", camera_optimizer="SE3")
    model: Any = trainer.model.eval()
    torch.manual_seed(0)
    batch = draw_batch(trainer.train_set, 64, "white")
    white = torch.ones(3)
    with torch.no_grad():
        before, first = model.render(batch.rays, white).rgb, model.loss(batch, 0).terms["rgb"]
        model.poses.tangents.data[:] = 0.3 * MOTION
        moved = replace(batch, rays=model.poses(batch.rays))
        refined = model.loss(batch, 0).terms["rgb"]
        torch.testing.assert_close(model.render(batch.rays, white).rgb, before)
        view = trainer.train_set.view(0)
        cameras = replace(view.camera, camera_to_worlds=model.refined_poses(view.camera.camera_to_worlds, False))
        elsewhere = model.render_view(replace(view, camera=cameras), white).rgb
        model.poses.tangents.data.zero_()
        torch.testing.assert_close(model.loss(moved, 0).terms["rgb"], refined)
        torch.testing.assert_close(model.render_view(replace(view, camera=cameras), white).rgb, elsewhere)
    assert abs(float(refined) - float(first)) > 1e-6
