"""A teacher beside the photographs: its share, its frame, its rays, and refused teachers."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom import PixelBatch, Rays
from nerfloom.base.device import seed_step
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.cli import train as train_command
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.data.scene import Scene
from nerfloom.data.sources import BatchSource, Request
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.files import write_octree
from nerfloom.registry import load_method
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.look import OURS
from nerfloom.splats.start import from_points
from nerfloom.testing.scenes import ball_in_a_box, ball_under_a_sky
from nerfloom.training import load as loading
from nerfloom.training import taught as taught_file
from nerfloom.training.checkpoint import load_checkpoint
from nerfloom.training.run import read_run
from nerfloom.training.taught import MixedSource, TaughtPixels, TaughtViews, is_taught, random_part
from nerfloom.training.teacher import Teacher
from nerfloom.training.trainer import Trainer
from tests.blocks.fakes import Drifted, cameras, placement
from tests.cli.helpers import called
from tests.conftest import Refused
from tests.octrees.balls import CELL, RADIUS, ball
from tests.octrees.test_drawn import front
from tests.training.helpers import TINY, assert_same_bits, tensors, tiny_run, tiny_trainer
from tests.training.taught import SHARP, THICK, marble, placed
from tests.web.helpers import some_cameras

BLACK = torch.zeros(3)

# -- the share of the teacher ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0, 0.125, 0.25, 0.5, 0.75, 1])
@pytest.mark.parametrize("first", [0, 64, 1024])
def test_a_share_is_kept_within_a_few_steps(share: float, first: int) -> None:
    assert sum(is_taught(step, share) for step in range(first, first + 64)) == pytest.approx(64 * share, abs=2)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.75])
@pytest.mark.parametrize("every", [2, 3, 4, 5, 8, 16, 25])
def test_a_share_is_kept_of_every_fourth_step_too(share: float, every: int) -> None:
    """Samplers learn at such steps only; they must not learn from the teacher alone."""
    assert sum(is_taught(every * number, share) for number in range(256)) / 256 == pytest.approx(share, abs=0.03)


@pytest.mark.parametrize("share", [0.1, 1 / 3, 0.7, 0.99])
def test_any_share_is_kept_from_the_first_step_on(share: float) -> None:
    done = 0
    for step in range(5000):
        done += is_taught(step, share)
        assert abs(done - share * (step + 1)) <= 1 + math.log2(step + 1)


class Named(BatchSource):
    """Draws its own name, and records its arguments."""

    contradicted: Any = SimpleNamespace(state=torch.tensor([7.0]))

    def __init__(self, name: str) -> None:
        self.name, self.learnt, self.dataset = name, list[int](), ball_in_a_box(4)

    def draw(self, request: Request) -> str:
        return self.name

    def drawing_from(self, dataset: Dataset) -> "Named":
        return Named(self.name + "'")

    def learn(self, request: Request, batch: Any, rgb: Tensor) -> None:
        self.learnt.append(request.step)


def test_photographs_finish() -> None:
    photographs, taught = Named("photographs"), Named("taught")
    mixed = MixedSource(photographs, taught, 1.0, 0.5)

    def drawn(progress: float) -> list[str]:
        return [mixed.draw(Request(step, 0, progress=progress)) for step in range(64)]

    assert drawn(0.0).count("taught") == 64
    assert drawn(0.25).count("taught") == pytest.approx(32, abs=2)
    assert drawn(0.375).count("taught") == pytest.approx(16, abs=2)
    assert drawn(0.5).count("taught") == drawn(1.0).count("taught") == 0
    mixed.until = math.inf
    assert drawn(1.0).count("taught") == 64
    mixed.until = 0.5
    for step in range(8):
        mixed.learn(Request(step, 0, progress=0.25), None, BLACK)
    assert sorted(photographs.learnt + taught.learnt) == list(range(8))
    assert len(taught.learnt) == pytest.approx(4, abs=1)
    assert mixed.varies is not None
    assert mixed.state().tolist() == [7.0]
    changed = mixed.drawing_from(ball_in_a_box(4))
    assert {changed.draw(Request(step, 0, progress=0.25)) for step in range(8)} == {"photographs'", "taught'"}


# -- the frame of the teacher ---------------------------------------------------------------------------------------


def test_what_is_between_two_scenes() -> None:
    one, other = placed(1, 0.5), placed(2, 3.0)
    rotation, scale, shift = one.similarity_to(other)
    points = torch.randn(50, 3, dtype=torch.float64)
    expected = other.points(one.original_points(points))
    torch.testing.assert_close(scale * points @ rotation.T + shift, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_rays_are_those_of_the_pupils_cameras(model: str) -> None:
    own, pupil = placed(1, 0.5), placed(2, 3.0)
    octree = ball()
    teacher, camera = Teacher(DrawnOctree(octree, octree.scene), own, pupil), replace(front(), model=model)
    pixels, (rotation, scale, shift) = torch.arange(0, 1600, 37), pupil.similarity_to(own)
    given, found = (each.pixel_rays(pixels, 0.0, 1.0) for each in (camera, teacher.cameras(camera)))
    origins = scale * given.origins.double() @ rotation.T + shift
    torch.testing.assert_close(found.origins.double(), origins, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.directions.double(), given.directions.double() @ rotation.T, rtol=0, atol=1e-5)


def test_a_teacher_that_has_refined_its_poses_sees_cameras_where_its_scene_is() -> None:
    teacher = Teacher(Drifted(torch.zeros(3, 4)), placement(3.0), placement(0.5))
    found = teacher.cameras(cameras([(0.5, 0.0, 0.0)])).camera_to_worlds
    torch.testing.assert_close(found[0, :, 3], torch.tensor([3.5, 0.0, 0.0]))


def test_a_picture_is_the_same_in_another_frame() -> None:
    octree, own, pupil = ball(), placed(1, 0.5), placed(2, 3.0)
    model = DrawnOctree(octree, octree.scene)
    truth = model.render_view(View(front()), BLACK)
    pose = pupil.poses(own.original_poses(front().camera_to_worlds)).float()
    shown = Teacher(model, own, pupil).picture(View(replace(front(), camera_to_worlds=pose)), BLACK)
    assert float((shown.rgb - truth.rgb).abs().mean()) < 1e-3
    assert float((shown.accumulation - truth.accumulation).abs().mean()) < 1e-3
    apart = (shown.median_depth * own.scale / pupil.scale - truth.median_depth).abs()
    assert float(apart.median()) < 1e-4
    assert float(apart.mean()) < 2e-2


def test_density_and_colours_at_points() -> None:
    """A density is per length: in a scene of six times the scale, it is a sixth."""
    own, pupil = placed(1, 0.5), placed(2, 3.0)
    rotation, scale, shift = pupil.similarity_to(own)
    assert scale == pytest.approx(1 / 6)
    there = 0.5 * torch.randn(40, 3, dtype=torch.float64)
    here = ((there - shift) / scale) @ rotation
    ahead = torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64), dim=-1)
    density, rgb = Teacher(marble(), own, pupil).at_points(here.float(), ahead.float(), 0.1)
    expected = THICK * torch.exp(-SHARP * there.square().sum(-1)) / 6
    torch.testing.assert_close(density.double(), expected, rtol=1e-3, atol=1e-5)
    colors = (0.5 + 0.2 * there + 0.2 * ahead @ rotation.T).clamp(0, 1)
    torch.testing.assert_close(rgb.double(), colors, rtol=0, atol=1e-4)


# -- batches --------------------------------------------------------------------------------------------------------


def octree_teacher(dataset: Dataset) -> tuple[DrawnOctree, Placement, Teacher]:
    """A ball of radius 0.71 in the scene of the images, and the placement of its own scene."""
    turned = placed(3, 1.0).transform[:, :3]
    octree, own = ball(), Placement(torch.cat([turned, torch.zeros(3, 1, dtype=torch.float64)], dim=-1), 0.7)
    model = DrawnOctree(octree, octree.scene)
    return model, own, Teacher(model, own, dataset.placement)


def drawn(source: BatchSource, count: int, rays_per_pixel: int = 1, seed: int = 1) -> Any:
    seed_step(seed, 0)
    return source.draw(Request(0, count, rays_per_pixel))


@pytest.mark.parametrize("rays_per_pixel", [1, 4])
def test_pixels_show_what_the_teacher_sees_along_their_rays(rays_per_pixel: int) -> None:
    dataset = ball_in_a_box()
    model, own, teacher = octree_teacher(dataset)
    batch = drawn(TaughtPixels(teacher, dataset, "random"), 400, rays_per_pixel)
    assert isinstance(batch, PixelBatch)
    assert (len(batch), batch.rays_per_pixel, batch.rays.camera_indices) == (400, rays_per_pixel, None)
    assert bool(((batch.pixels >= 0) & (batch.pixels < len(dataset.pixels))).all())
    assert float(batch.rays.origins.norm(dim=-1).max()) < 4  # cameras are at distance 3
    rotation, scale, shift = dataset.placement.similarity_to(own)
    origins = scale * batch.rays.origins @ rotation.T.float() + shift.float()
    ends = (torch.full((len(origins),), end) for end in (model.scene.near, model.scene.far))
    rays = Rays(origins, batch.rays.directions @ rotation.T.float(), *ends)
    seen = model.render(rays, batch.background.repeat_interleave(rays_per_pixel, 0)).to_pixels(rays_per_pixel)
    assert float((batch.rgb - seen.rgb.clamp(0, 1)).abs().mean()) < 1e-3
    assert batch.alpha is not None
    assert float((batch.alpha - seen.accumulation).abs().mean()) < 1e-3
    assert 0.1 < float(batch.alpha.mean()) < 0.9
    assert batch.distances is not None
    opaque = batch.distances > 0
    assert torch.equal(opaque, batch.alpha > taught_file.OPAQUE)
    first = batch.rays[torch.arange(len(batch)) * rays_per_pixel]
    ends_at = (first.origins + batch.distances[:, None] * first.directions)[opaque].norm(dim=-1)
    assert float((ends_at - RADIUS / 0.7).abs().median()) < CELL / 0.7


def test_a_seed_gives_its_batch_and_others_give_others() -> None:
    dataset = ball_in_a_box()
    source = TaughtPixels(octree_teacher(dataset)[2], dataset, "random")
    one, again, other = drawn(source, 64), drawn(source, 64), drawn(source, 64, seed=2)
    assert len(one) == 64
    assert torch.equal(one.rays.origins, again.rays.origins)
    assert torch.equal(one.rgb, again.rgb)
    assert not torch.equal(one.rays.origins, other.rays.origins)
    assert len(one.rays.origins.unique(dim=0)) == taught_file.VIEWS
    assert len(drawn(source, 1)) == 1


def test_photographs_without_alpha_have_none_of_the_teacher_either() -> None:
    dataset = ball_under_a_sky()
    batch = drawn(TaughtPixels(octree_teacher(dataset)[2], dataset, "black"), 64)
    assert batch.alpha is None
    assert not bool(batch.background.any())


def test_whole_pictures_without_alpha_have_the_background_that_was_asked_for() -> None:
    dataset = ball_under_a_sky()
    teacher = octree_teacher(dataset)[2]
    batch = drawn(TaughtViews(teacher.picture, dataset, "white", seed=5), 0)
    assert batch.alpha is None
    expected = teacher.picture(batch.view, torch.ones(3))
    assert float(expected.accumulation.min()) < 0.5
    torch.testing.assert_close(batch.rgb, expected.rgb, rtol=0, atol=3e-3)


def test_gaussians_teach_pixels() -> None:
    dataset = ball_in_a_box()
    gaussians = from_points(0.3 * torch.randn(200, 3), torch.rand(200, 3), 0)
    model = DrawnGaussians(gaussians, OURS, dataset.scene)
    batch = drawn(TaughtPixels(Teacher(model, dataset.placement, dataset.placement), dataset, "white"), 64)
    assert len(batch) == 64
    assert bool(batch.rgb.isfinite().all())
    assert 0 <= float(batch.alpha.min()) <= float(batch.alpha.max()) <= 1


class Counted(Teacher):
    """Counts its pictures."""

    count = 0

    def picture(self, view: View, background: Tensor) -> Picture:
        self.count += 1
        return super().picture(view, background)


def test_whole_pictures_are_rendered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taught_file, "PICTURES", 3)
    dataset = ball_in_a_box()
    model, own, _ = octree_teacher(dataset)
    teacher = Counted(model, own, dataset.placement)
    one, other = (TaughtViews(teacher.picture, dataset, "random", seed=5) for _ in range(2))
    batches = [drawn(one, 0, seed=seed) for seed in range(30)]
    assert teacher.count == 3
    assert len({batch.view.camera.camera_to_worlds.flatten().tolist()[3] for batch in batches}) == 3
    for batch in batches[:4]:
        assert isinstance(batch, ViewBatch)
        assert batch.index is None
        expected = teacher.picture(batch.view, batch.background)
        torch.testing.assert_close(batch.rgb, expected.rgb, rtol=0, atol=3e-3)
        torch.testing.assert_close(batch.alpha, expected.accumulation, rtol=0, atol=1e-3)
    for seed in (7, 3):  # in another order
        mine, theirs = batches[seed], drawn(other, 0, seed=seed)
        assert torch.equal(mine.rgb, theirs.rgb)
        assert torch.equal(mine.view.camera.camera_to_worlds, theirs.view.camera.camera_to_worlds)


def test_every_nth_picture_is_from_an_unseen_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taught_file, "PICTURES", 8)
    dataset = ball_in_a_box()
    source = TaughtViews(octree_teacher(dataset)[2].picture, dataset, "white", seed=5, unseen_every=4)
    poses = {tuple(drawn(source, 0, seed=n).view.camera.camera_to_worlds.flatten().tolist()) for n in range(100)}
    known = set(map(tuple, dataset.cameras.camera_to_worlds.flatten(1).tolist()))
    unseen = poses - known
    assert len(unseen) == 2
    assert 1 <= len(poses & known) <= 6  # each training camera once before any twice


def test_large_pictures_are_reduced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(taught_file, "MAX_SIDE", 12)
    dataset = ball_in_a_box()
    batch = drawn(TaughtViews(octree_teacher(dataset)[2].picture, dataset, "white", 0), 0)
    assert batch.rgb.shape == (12, 12, 3)
    assert batch.view.camera.sizes == [[12, 12]]


def test_a_part_of_an_image_sees_what_the_image_sees_there() -> None:
    torch.manual_seed(1)
    camera = some_cameras()[:1]
    part, (rows, columns) = random_part(camera, 100)
    assert part.sizes == [[75, 100]]
    assert (rows.stop - rows.start, columns.stop - columns.start) == (75, 100)
    assert 0 <= rows.start <= 75
    assert 0 <= columns.start <= 100
    points = torch.randn(20, 3) * 0.2
    whole, some = camera.project(points, 0), part.project(points, 0)
    torch.testing.assert_close(some[0], whole[0] - columns.start)
    torch.testing.assert_close(some[1], whole[1] - rows.start)
    assert random_part(camera, 200)[0].sizes == camera.sizes == [[150, 200]]


def test_pictures_that_are_rendered_ahead_are_all_that_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fewest and smallest if there is no time. Their views and their parts of images differ."""
    monkeypatch.setattr(taught_file, "MAX_PICTURES", 9)
    dataset = ball_in_a_box(24)
    model, own, _ = octree_teacher(dataset)
    teacher = Counted(model, own, dataset.placement)
    source = TaughtViews(teacher.picture, dataset, "white", seed=5)
    source.render_ahead(0.0)
    assert teacher.count == source.count == taught_file.MIN_PICTURES
    cameras = [drawn(source, 0, seed=seed).view.camera for seed in range(60)]
    assert teacher.count == taught_file.MIN_PICTURES
    assert len({tuple(camera.camera_to_worlds.flatten().tolist()) for camera in cameras}) > 1
    assert len({(float(camera.cx), float(camera.cy)) for camera in cameras}) > 1
    assert all(camera.sizes == [[12, 12]] for camera in cameras)
    source = TaughtViews(teacher.picture, dataset, "white", seed=5)
    source.render_ahead(math.inf)
    sides = [drawn(source, 0, seed=seed).rgb.shape[0] for seed in range(60)]
    assert source.count == 9
    assert set(sides) == {12, 24}


# -- trainings ------------------------------------------------------------------------------------------------------


def octree_file(folder: Path, placement: Placement | None = None) -> Path:
    """An octree of a ball of radius 1 in the input, as the one of the tiny data set."""
    file = folder / "ball.octree"
    write_octree(file, replace(ball(), placement=placement or Placement.of(torch.eye(3, 4), RADIUS)))
    return file


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["instant-ngp", "gaussian-splatting", "nerf-w", "vanilla-nerf", "neus"])
def test_methods_learn_from_both(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"teacher": octree_file(tmp_path), "teacher_share": 1.0, "depth_loss_mult": 0.1}
    trainer = tiny_trainer(kind, shared_tiny, tmp_path / "run", max_num_iterations=4, **settings)
    sources = [trainer.source.of(Request(step, 0, progress=step / 4)) for step in range(4)]
    assert [type(source) in (TaughtPixels, TaughtViews) for source in sources] == [True, True, True, False]
    trainer.train()
    assert (trainer.state.step, trainer.state.skipped) == (4, 0)


@pytest.mark.medium
def test_a_pupil_learns_what_the_teacher_knows() -> None:
    """The pupil learns from the teacher's views alone; the photographs show a ball of other colours."""
    dataset, method = ball_in_a_box(), load_method("instant-ngp")
    teacher = octree_teacher(dataset)[2]
    config = replace(method.config, vis="none", max_num_iterations=150, **TINY["instant-ngp"])
    trainer = Trainer(method, config, dataset, source=TaughtPixels(teacher, dataset, "random"))
    truth = [teacher.picture(dataset.view(index), BLACK).rgb for index in range(3)]

    def error() -> float:
        shown = [trainer.model.render_view(dataset.view(index), BLACK).rgb for index in range(3)]
        return float((torch.stack(shown) - torch.stack(truth)).square().mean())

    before = error()
    for _ in trainer.steps():
        pass
    print(f"mean squared error {before:.4f} -> {error():.4f}")
    assert error() < before / 3


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["instant-ngp", "gaussian-splatting"])
def test_resuming_continues_with_the_same_bits(kind: str, shared_tiny: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"teacher": octree_file(tmp_path), "max_num_iterations": 14}
    whole = tiny_trainer(kind, shared_tiny, tmp_path / "whole", **settings)
    whole.train()
    first = tiny_trainer(kind, shared_tiny, tmp_path / "parts", **settings)
    for _ in range(7):
        first.train_step()
    checkpoint = first.save()
    assert checkpoint is not None
    second = tiny_trainer(kind, shared_tiny, tmp_path / "second", **settings)
    second.restore(load_checkpoint(checkpoint))
    second.train()
    assert_same_bits(tensors(whole), tensors(second))


def test_a_run_knows_its_teacher(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The path of the teacher is found from any folder."""
    file = octree_file(tmp_path)
    monkeypatch.chdir(tmp_path)
    tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", teacher=Path(file.name), teacher_share=0.25)
    config = read_run(tmp_path / "run").config
    assert (config.teacher, config.teacher_share, config.teacher_until) == (file.resolve(), 0.25, 0.8)


# -- what cannot teach ----------------------------------------------------------------------------------------------


def refused_teacher(shared_tiny: Path, tmp_path: Path, teacher: Path, kind: str = "instant-ngp") -> str:
    """The one-line refusal of a teacher, before a step."""
    with pytest.raises(ConfigError) as error:
        tiny_trainer(kind, shared_tiny, tmp_path / "pupil", teacher=teacher)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith("--teacher")
    return str(error.value)


def test_a_teacher_that_is_not_there(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    missing = tmp_path / "nowhere"
    assert f"cannot read {missing}" in refused_teacher(shared_tiny, tmp_path, missing)
    out = tmp_path / "out"
    words = ("--data", shared_tiny, "--output-dir", out, "--teacher", missing)
    said = refused(train_command.main, "instant-ngp", *words)
    assert f"--teacher {missing}: there is no such run or file" in said
    assert not out.exists()


@pytest.mark.medium
def test_a_run_goes_on_without_a_teacher_that_is_gone(shared_tiny: Path, tmp_path: Path, refused: Refused) -> None:
    """If one says so. A trained run is opened without."""
    file = octree_file(tmp_path)
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", teacher=file, max_num_iterations=2)
    trainer.train_step()
    trainer.save()
    file.unlink()
    assert "--teacher None" in refused(train_command.main, "--resume", tmp_path / "run")
    assert loading.load(tmp_path / "run", device_type="cpu").step == 1
    done = called("ns-train", "--resume", tmp_path / "run", "--teacher", "None", "--max-eval-images", 0)
    assert done.returncode == 0, done.stderr
    assert loading.load(tmp_path / "run", device_type="cpu").step == 2


def test_a_teacher_that_has_not_learnt_and_a_folder_of_runs(shared_tiny: Path, tmp_path: Path) -> None:
    tiny_trainer("instant-ngp", shared_tiny, tmp_path / "runs" / "one")
    assert "holds no checkpoint" in refused_teacher(shared_tiny, tmp_path, tmp_path / "runs" / "one")
    (tmp_path / "pupil" / "config.yml").unlink()
    said = refused_teacher(shared_tiny, tmp_path, tmp_path / "runs")
    assert f"name one of them, such as {tmp_path / 'runs' / 'one'}" in said


def test_a_teacher_of_another_place(shared_tiny: Path, tmp_path: Path) -> None:
    far = torch.eye(3, 4)
    far[0, 3] = 1000.0
    said = refused_teacher(shared_tiny, tmp_path, octree_file(tmp_path, Placement.of(far, RADIUS)))
    assert "was it trained on other data?" in said


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"moving": True}, "the photographs have no times"),
        ({"warped": True}, "--ndc"),
        ({"num_scenes": 2}, "here are several"),
    ],
)
def test_a_teacher_of_another_kind_of_scene(
    facts: dict[str, Any], words: str, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = octree_file(tmp_path)
    loaded = loading.load(file, device_type="cpu")
    scene: Scene = replace(loaded.model.scene, **facts)
    other = replace(loaded, model=DrawnOctree(ball(), scene))
    monkeypatch.setattr(loading, "load", lambda *_, **__: other)
    assert words in refused_teacher(shared_tiny, tmp_path, file)


def test_a_method_that_renders_from_photographs_has_no_teacher(shared_tiny: Path, tmp_path: Path) -> None:
    assert "renders from photographs" in refused_teacher(shared_tiny, tmp_path, octree_file(tmp_path), "pixel-nerf")


def test_points_need_a_field(shared_tiny: Path, tmp_path: Path) -> None:
    """An octree has a density, and no colours at points; its pictures can be learnt from."""
    file = octree_file(tmp_path)
    assert "--distill-steps 0" in refused_teacher(shared_tiny, tmp_path, file, "kilo-nerf")
    settings: dict[str, Any] = {"teacher": file, "distill_steps": 0, "teacher_share": 0.5}
    run = tiny_run("kilo-nerf", shared_tiny, tmp_path / "other", **settings)
    (tmp_path / "other").mkdir()
    trainer = Trainer.of(run, ball_in_a_box())
    assert isinstance(trainer.source, MixedSource)
