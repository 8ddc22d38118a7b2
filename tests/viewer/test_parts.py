"""Parts of the viewer beside pictures: crops, errors against photographs, cells, curves, newer checkpoints."""

import dataclasses
import itertools
import json
import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import nn

from nerfloom.base import extras
from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import ConfigError
from nerfloom.base.machine_config import ViewerConfig
from nerfloom.cameras.outline import outlined
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.cli import train as train_command
from nerfloom.cli import viewer as viewer_command
from nerfloom.data.scene import Scene
from nerfloom.geometry.rays import Rays
from nerfloom.geometry.regions import AXES, Box, Polygon
from nerfloom.methods.gaussian_splatting import GaussianSplatting, GaussianSplattingConfig, decide
from nerfloom.renderable import Renderable, RendersRays
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.splats.gaussians import Gaussians
from nerfloom.training.checkpoint import list_checkpoints
from nerfloom.training.loaded import Loaded
from nerfloom.training.run import Run
from nerfloom.training.trained import load_trained
from nerfloom.viewer.browser import Browser
from nerfloom.viewer.camera_panel import CameraPanel
from nerfloom.viewer.crop import CroppedCameras, parts_within, picture_within, views_within
from nerfloom.viewer.crop_panel import FACES, dragged, edges, middle, outward
from nerfloom.viewer.markdown import plain
from nerfloom.viewer.occupancy import shown_cells
from nerfloom.viewer.pace import Speed
from nerfloom.viewer.photographs import THUMBNAIL, Photographs, small_picture
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.reports import curve, heading
from nerfloom.viewer.request import Crop, Pose, Request
from nerfloom.viewer.trained_viewer import newer_checkpoint, reloaded
from tests.conftest import Refused
from tests.training.helpers import tiny_run, tiny_trainer

ABOVE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4.0)
"""A camera at (0, 0, 4) that looks down."""


def test_cropped_rays() -> None:
    camera = Request(Pose(ABOVE, 1.2), 9, 9).camera()
    whole = camera.pixel_rays(torch.arange(81), 0.5, 10.0)
    crop = Crop(Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    rays = CroppedCameras.of(camera, crop).pixel_rays(torch.arange(81), 0.5, 10.0)
    torch.testing.assert_close(rays.directions, whole.directions)
    assert float(rays.nears[40]) == pytest.approx(3)  # the middle pixel looks along the axis
    assert float(rays.fars[40]) == pytest.approx(5)
    assert float((rays.fars - rays.nears)[0]) == 0  # the corner's ray misses the box
    assert bool((rays.fars >= rays.nears).all())
    ends = whole.origins + whole.directions * rays.fars[:, None]
    hit = rays.fars > rays.nears
    assert bool((ends[hit].abs().amax(-1) - 1).abs().lt(1e-5).all())
    between = CroppedCameras.of(camera, dataclasses.replace(crop, near=3.5, far=4.5)).pixel_rays(
        torch.tensor([40]), 0.5, 10.0
    )
    assert (float(between.nears), float(between.fars)) == pytest.approx((3.5, 4.5))


SMALL = Request(Pose(ABOVE, 1.2), 9, 9).camera()
"""Its picture of 9 x 9 pixels."""
SIDE = Polygon(
    (6.0, 0.1, 0.2),
    ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    ((-0.15, -0.15), (0.15, -0.15), (0.15, -0.05), (0.0, -0.05), (0.0, 0.2), (-0.15, 0.2)),
    keep=False,
)
"""All but an L in the picture of a camera on the x axis."""
CROPS = {
    "removed": Crop(polygons=(SIDE,)),
    "kept": Crop(polygons=(dataclasses.replace(SIDE, keep=True),)),
    "its-own-view": Crop(polygons=(outlined(SMALL, ((0.7, 1.2), (6.3, 2.4), (3.1, 7.6))),)),
    "all": Crop(Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0)), 2.5, 5.5, (
        SIDE, dataclasses.replace(SIDE, position=(6.0, 0.9, 0.4)),
        Polygon((0.0, 0.0, 9.0), AXES, ((-0.25, -0.2), (0.2, -0.15), (0.05, 0.25))),
    )),
}  # fmt: skip


def steps_within(rays: Rays, crop: Crop) -> torch.Tensor:
    """Which of 2000 positions along each ray are in a crop (R, 2000); the step is a hundredth of 0.475."""
    t = 0.5 + (torch.arange(2000) + 0.5) * (9.5 / 2000)
    points = rays.origins[:, None] + t[:, None] * rays.directions[:, None]
    inside = crop.contains(points.view(-1, 3)).view(len(rays), -1)
    return inside & (t >= crop.near) & (t <= crop.far)


@pytest.mark.parametrize("crop", CROPS.values(), ids=CROPS)
def test_parts_of_rays_are_what_is_within_polygons(crop: Crop) -> None:
    rays = SMALL.pixel_rays(torch.arange(81), 0.5, 10.0)
    parts, inside = parts_within(rays, crop), steps_within(rays, crop)
    t = 0.5 + (torch.arange(2000) + 0.5) * (9.5 / 2000)
    found = torch.zeros_like(inside)
    for before, part in itertools.pairwise([None, *parts]):
        assert part is not None
        assert bool((part.fars >= part.nears).all())
        if before is not None:  # a missing part is at the end of the ray
            assert bool((part.nears >= before.fars).all())
        found |= (t > part.nears[:, None]) & (t < part.fars[:, None])
    edges = inside[:, 1:] != inside[:, :-1]
    assert int((found != inside).sum()) <= int(edges.sum())  # a step at each edge
    assert 0.005 < inside.float().mean() < 0.95
    at_once = [CroppedCameras.of(SMALL, crop, part) for part in (0, 1, 9)]
    given = [camera.pixel_rays(torch.arange(81), 0.5, 10.0) for camera in at_once]
    torch.testing.assert_close(given[0].nears, parts[0].nears)
    assert bool((given[1].fars > given[1].nears).any()) == (len(parts) > 1)
    assert not bool((given[2].fars > given[2].nears).any())
    views = views_within(View(SMALL), crop, 4.0, 4.0, 0.5, 10.0)  # of the ray in the middle
    ends = [view.camera.pixel_rays(torch.tensor([40]), 0.5, 10.0).fars for view in views]
    torch.testing.assert_close(ends, [part.fars for part in parts_within(rays[40:41], crop)])


class Fog(RendersRays):
    """Grey matter of the same density everywhere."""

    device, rays_at_once = torch.device("cpu"), 2**16  # type: ignore[assignment]
    scene = Scene(torch.tensor([[-3.0] * 3, [3.0] * 3]), 0.5, 10.0, 4, True, False, 32, image_pixels=32 * 32)

    def render(self, rays: Rays, background: torch.Tensor) -> Rendered:
        share = 1 - (-0.4 * (rays.fars - rays.nears)).exp()
        rgb = 0.3 * share[:, None] + (1 - share[:, None]) * background
        return Rendered(rgb, rays.nears, rays.nears, share, len(rays))

    def render_view(self, view: View, background: torch.Tensor) -> Picture:
        rays = view.camera.pixel_rays(view.camera.image_pixels(0), self.scene.near, self.scene.far)
        found, size = self.render(rays, background), (view.height, view.width)
        depths = (values.view(size) for values in (found.depth, found.median_depth, found.accumulation))
        return Picture(found.rgb.view(*size, 3), *depths)


@pytest.mark.parametrize("crop", CROPS.values(), ids=CROPS)
def test_fog_within_polygons_is_as_dense_as_the_length_of_its_parts(crop: Crop) -> None:
    """The parts of a ray are composited: transmittances multiply, so lengths add up."""
    camera, background = SMALL, torch.tensor([1.0, 0.5, 0.0])
    found = picture_within(Fog(), View(camera), crop, background)
    length = steps_within(camera.pixel_rays(torch.arange(81), 0.5, 10.0), crop).sum(-1) * (9.5 / 2000)
    share = (1 - (-0.4 * length).exp()).view(9, 9)
    torch.testing.assert_close(found.accumulation, share, atol=5e-3, rtol=0)
    expected = 0.3 * share[..., None] + (1 - share[..., None]) * background
    torch.testing.assert_close(found.rgb, expected, atol=5e-3, rtol=0)


def test_the_edges_and_the_arrows_of_the_box() -> None:
    """Twelve edges between its corners; at each face an arrow at its centre, which points away from the box."""
    box = Box((-1.0, 2.0, 3.0), (1.0, 5.0, 4.0))
    found = edges(box).astype(float)
    lengths = np.linalg.norm(found[:, 1] - found[:, 0], axis=1)
    assert sorted(lengths.tolist()) == [1] * 4 + [2] * 4 + [3] * 4
    corners = {tuple(corner) for corner in found.reshape(-1, 3).tolist()}
    assert corners == set(itertools.product((-1, 1), (2, 5), (3, 4)))
    for axis, side in FACES:
        place = np.array(middle(box, (axis, side)))
        assert place[axis] == (box.low, box.high)[side][axis]
        assert np.delete(place - [0, 3.5, 3.5], axis).tolist() == [0, 0]
        w, *vector = outward((axis, side))
        turn = 2 * np.outer(vector, vector) + (2 * w * w - 1) * np.eye(3)  # of quaternions with w = 0 or 1
        assert (turn @ np.eye(3)[axis]).tolist() == ((2 * side - 1) * np.eye(3)[axis]).tolist()


def test_a_dragged_face_keeps_its_distance_from_the_other_one() -> None:
    box = Box((-1.0, 2.0, 3.0), (1.0, 5.0, 3.25))
    assert dragged(box, (0, 1), 4.0, 0.5) == (4.0, 5.0, 3.25)
    assert dragged(box, (0, 1), -7.0, 0.5) == (-0.5, 5.0, 3.25)
    assert dragged(box, (1, 0), 9.0, 0.5) == (-1.0, 4.5, 3.0)
    for face, corner in (((2, 0), box.low), ((2, 1), box.high)):  # thinner than that, it stays where it is
        assert dragged(box, face, middle(box, face)[2], 0.5) == corner


def test_gaussians_outside_of_a_crop_are_not_drawn() -> None:
    """A red wall before a green ball: a crop without the wall shows the ball behind it."""
    scene = Scene(torch.tensor([[-3.0] * 3, [3.0] * 3]), 0.1, 10.0, 4, True, False, 32, image_pixels=32 * 32)
    model = GaussianSplatting(decide(GaussianSplattingConfig(degree=0, max_seconds=10.0), scene)[0], scene).eval()
    centers = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    sizes, turns = torch.tensor([[2.0, 2.0, 0.01], [0.3, 0.3, 0.3]]).log(), torch.tensor([[1.0, 0, 0, 0]] * 2)
    light = torch.tensor([[1.77, -1.77, -1.77], [-1.77, 1.77, -1.77]])  # 0.5 + 0.282 times these: red, green
    model.set_gaussians(Gaussians(centers, sizes, turns, torch.full((2,), 20.0), light, torch.zeros(2, 3, 0)))
    view, white = View(Request(Pose(ABOVE, 1.2), 33, 33).camera()), torch.ones(3)
    corner = (3.0, 3.0, 3.0)

    def middle(crop: Crop) -> list[int]:
        found: list[int] = picture_within(model, view, crop, white).rgb[16, 16].round().int().tolist()
        return found

    assert middle(Crop(Box((-3.0, -3.0, -3.0), corner))) == [1, 0, 0]
    assert middle(Crop(Box((-3.0, -3.0, -3.0), (3.0, 3.0, 1.0)))) == [0, 1, 0]
    assert middle(Crop(Box((-3.0, -3.0, 1.0), corner), near=2.5)) == [1, 1, 1]  # the wall is 2 away
    assert middle(Crop(Box((-3.0, -3.0, -3.0), corner), near=2.5)) == [0, 1, 0]
    assert middle(Crop(Box((-3.0, -3.0, -3.0), corner), far=1.5)) == [1, 1, 1]
    wall = Polygon((9.0, 0.0, 2.0), SIDE.axes, ((-0.5, -0.1), (0.5, -0.1), (0.5, 0.1), (-0.5, 0.1)))
    assert middle(Crop(polygons=(wall,))) == [1, 0, 0]
    assert middle(Crop(polygons=(dataclasses.replace(wall, keep=False),))) == [0, 1, 0]
    both = dataclasses.replace(wall, position=(0.0, 0.0, 9.0), axes=AXES, keep=False)  # from above
    assert middle(Crop(polygons=(wall, both))) == [1, 1, 1]


class Slow(Speed):
    """A speed that makes strips of a few rows, for all measured times."""

    def with_one(self, rays: int, seconds: float) -> Speed:
        return self


def test_gaussians_are_drawn_as_a_whole_however_slow_that_is() -> None:
    """A large Gaussian beside the image reaches into it; strips of the image would show another picture."""
    scene = Scene(torch.tensor([[-3.0] * 3, [3.0] * 3]), 0.1, 10.0, 4, True, False, 32, image_pixels=32 * 32)
    model = GaussianSplatting(decide(GaussianSplattingConfig(degree=0, max_seconds=10.0), scene)[0], scene).eval()
    turn, light = torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[1.77, -1.77, -1.77]])
    sizes = torch.tensor([[1.0, 0.2, 2.0]]).log()
    beside = Gaussians(torch.tensor([[0.0, 1.0, 3.0]]), sizes, turn, torch.full((1,), 4.0), light, torch.zeros(1, 3, 0))
    model.set_gaussians(beside)
    request, shown = Request(Pose(ABOVE, 1.2), 64, 64), list[np.ndarray]()
    whole = model.render_view(View(request.camera()), torch.ones(3)).rgb
    strips = [model.render_view(View(request.camera(rows=rows)), torch.ones(3)).rgb for rows in ((0, 32), (32, 64))]
    assert float((torch.cat(strips) - whole).abs().max()) > 0.1  # so it matters
    placement, file = Placement(torch.eye(4)[:3].double(), 1.0), Path("splat.ply")
    queue = RenderQueue(Loaded(model, placement, "gaussian-splatting", file, file))
    queue._speed = Slow(((64 * 64, 100.0),))
    queue.add(1, Browser(lambda image, quality: shown.append(image)))
    queue.ask(1, lambda _: request)
    while queue.draw_next() is not None or queue._browsers[1].pieces:
        time.sleep(0.02)
    np.testing.assert_allclose(shown[-1] / 255, whole.numpy(), atol=0.01)


@pytest.fixture
def photographs(shared_tiny: Path, tmp_path: Path) -> Photographs:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path)
    return Photographs(tiny_run("instant-ngp", shared_tiny, tmp_path), lambda: trainer.model)


def test_photographs_stand_where_their_refined_cameras_do(shared_tiny: Path, tmp_path: Path) -> None:
    """Each is moved by the model's present refinement."""
    trainer = tiny_trainer("nerfacto", shared_tiny, tmp_path / "run", sampler="proposal", camera_optimizer="SO3xR3")
    photographs = Photographs(tiny_run("nerfacto", shared_tiny, tmp_path / "run"), lambda: trainer.model)
    before = at(photographs, 3)
    assert photographs.at(before) == 3
    shift = torch.tensor([0.3, -0.2, 0.4])
    trainer.model.poses.tangents.data[:, :3] = shift
    assert photographs.at(before) is None
    after = at(photographs, 3)
    torch.testing.assert_close((after.tensor() - before.tensor())[:, 3].float(), shift, atol=1e-5, rtol=0)
    assert photographs.at(after) == 3
    view = View(Request(after, 20, 20).camera())
    found = photographs.truth(view, torch.zeros(20, 20, 3), torch.ones(3))
    rgba = torch.from_numpy(iio.imread(shared_tiny / "train" / "r_3.png").copy()).float() / 255
    assert found is not None
    torch.testing.assert_close(found, rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]), atol=1e-4, rtol=0)


def at(photographs: Photographs, index: int) -> Pose:
    return Pose(tuple(photographs.pose(index).double().flatten().tolist()), photographs.fov(index))


def test_a_photograph_is_its_own_truth(photographs: Photographs, shared_tiny: Path) -> None:
    pose, white = at(photographs, 3), torch.ones(3)
    view = View(Request(pose, 20, 20).camera())
    found = photographs.truth(view, torch.zeros(20, 20, 3), white)
    rgba = torch.from_numpy(iio.imread(shared_tiny / "train" / "r_3.png").copy()).float() / 255
    expected = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
    assert found is not None
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)
    wide = View(Request(dataclasses.replace(pose, fov=1.5), 60, 60).camera())
    found = photographs.truth(wide, torch.full((60, 60, 3), 0.25), white)
    assert found is not None
    assert bool((found[0] == 0.25).all())  # outside of the photograph
    share = math.tan(photographs.fov(3) / 2) / math.tan(0.75)
    assert float((found != 0.25).any(-1).float().mean()) == pytest.approx(share**2, rel=0.1)


def test_elsewhere_there_is_no_truth(photographs: Photographs) -> None:
    pose = at(photographs, 3)
    assert photographs.at(pose) == 3
    matrix = list(pose.matrix)
    matrix[3] += 0.1
    assert photographs.at(dataclasses.replace(pose, matrix=tuple(matrix))) is None


@pytest.fixture
def still(shared_tiny: Path, tmp_path: Path) -> Photographs:
    """Three photographs of one place and one of another, at several times."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path)
    run = tiny_run("instant-ngp", shared_tiny, tmp_path)
    times = torch.tensor([0.0, 0.5, 1.0, 0.25])
    parsed = dataclasses.replace(run.parse("train")[torch.tensor([3, 3, 3, 5])], times=times)
    return Photographs(cast(Run, SimpleNamespace(parse=lambda split: parsed)), lambda: trainer.model)


def test_a_photograph_is_visited_at_its_time(still: Photographs) -> None:
    moves = list[tuple[Any, ...]]()
    kinds = ("add_checkbox", "add_number", "add_button", "add_markdown")
    handle = SimpleNamespace(value=0, content="", on_update=lambda action: None, on_click=lambda action: None)
    gui = SimpleNamespace(**{kind: lambda *_, **__: SimpleNamespace(**vars(handle)) for kind in kinds})
    panel = CameraPanel(cast(Any, SimpleNamespace(gui=gui)), still, lambda *how: moves.append(how))
    for _ in range(4):
        panel.step(1)
    assert [time for _, _, time in moves] == [0.5, 1.0, 0.25, 0.0]


def test_of_a_camera_that_stood_still_the_time_chooses_the_photograph(still: Photographs) -> None:
    pose = at(still, 0)
    assert [still.at(pose, time) for time in (0.0, 0.2, 0.3, 0.6, 0.9)] == [0, 0, 1, 1, 2]
    assert still.at(at(still, 3), 1.0) == 3  # of its camera there is one


def test_small_pictures(tmp_path: Path) -> None:
    big = np.full((400, 300, 3), (10, 200, 30), np.uint8)
    iio.imwrite(tmp_path / "big.jpg", big)
    small = small_picture(tmp_path / "big.jpg")
    assert small is not None
    assert max(small.shape[:2]) == THUMBNAIL
    assert np.abs(small.astype(int) - big[0, 0]).max() < 8
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n garbage")
    assert small_picture(tmp_path / "bad.png") is None
    assert small_picture(tmp_path / "none.png") is None


def test_cells_are_those_on_the_surface() -> None:
    sampler = OccupancySampler(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]), resolution=16)
    steps = (torch.arange(16) + 0.5) / 8 - 1
    centers = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1)
    sampler.occupied.copy_((centers.norm(dim=-1) < 0.7).view(-1))
    found = shown_cells(nn.Sequential(sampler))  # type: ignore[arg-type]
    assert found is not None
    points, edge = found
    assert edge == pytest.approx(0.125)
    radii = points.norm(dim=-1)
    assert float(radii.max()) < 0.7
    assert float(radii.min()) > 0.7 - 2 * 0.125
    assert len(points) > 4 * math.pi * 0.6**2 / 0.125**2 / 2
    assert len(shown_cells(nn.Sequential(sampler), 50)[0]) <= 50  # type: ignore[arg-type, index]
    assert shown_cells(nn.Linear(2, 2)) is None  # type: ignore[arg-type]


def at_step_7(folder: Path) -> Loaded:
    """A run without a model; the tests only need the text of its panel."""
    placement = Placement(torch.eye(4)[:3].double(), 1.0)
    return Loaded(cast(Renderable, None), placement, "instant-ngp", folder, folder / "step-7.ckpt", 7)


@pytest.mark.parametrize("content", ["", "nonsense", "[1, 2]", '{"results": 3}', "[" * 10_000, '[{"seconds": "x"}]'])
def test_reports_that_make_no_sense(content: str, tmp_path: Path) -> None:
    for name in ("learning_curve.json", "eval.json"):
        (tmp_path / name).write_text(content)
    assert curve(tmp_path) == ([], [])
    assert "step 7" in heading(at_step_7(tmp_path))


def test_names_and_messages_are_shown_as_they_are() -> None:
    assert plain("error: cannot read r_0.png (34 %)") == r"error: cannot read r\_0.png (34 %)"
    assert not set(plain("<img src=x> [a](b) *c* `d` &lt; #e {f} | ~g~ \\")) & set("<>[]*`&#{}|~\\")


def test_reports(tmp_path: Path) -> None:
    rows = [{"seconds": 2, "psnr": 20.5}, {"seconds": 1, "psnr": 10}, {"seconds": 3, "psnr": None}]
    (tmp_path / "learning_curve.json").write_text(json.dumps(rows))
    assert curve(tmp_path) == ([1, 2], [10, 20.5])
    (tmp_path / "eval.json").write_text('{"results": {"psnr": 31.234, "num_images": 5}}')
    assert "31.23 dB on 5 images" in heading(at_step_7(tmp_path))


def test_newer_checkpoints_are_loaded(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=40)
    for _ in range(10):
        trainer.train_step()
    trainer.save()
    trained = load_trained(tmp_path / "run", device_type="cpu")
    assert newer_checkpoint(tmp_path / "run", trained.checkpoint) is None
    for _ in range(10):
        trainer.train_step()
    trainer.save()
    newer = newer_checkpoint(tmp_path / "run", trained.checkpoint)
    assert newer is not None
    found = reloaded(trained, newer)
    assert not isinstance(found, str)
    assert (trained.step, found.step) == (10, 20)
    for name, value in trainer.model.state_dict().items():
        assert torch.equal(found.model.state_dict()[name], value)
    list_checkpoints(trainer.checkpoint_folder)[-1].write_bytes(b"damaged")
    assert "cannot be shown" in str(reloaded(trained, newer))


def test_what_is_missing_is_named(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, shared_tiny: Path, tmp_path: Path
) -> None:
    assert "no config.yml" in refused(viewer_command.main, tmp_path)
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    assert "pip install viser" in refused(viewer_command.main, tmp_path)
    words = ("--data", shared_tiny, "--output-dir", tmp_path, "--vis", "viewer")
    assert "pip install viser" in refused(train_command.main, "instant-ngp", *words)
    assert list(tmp_path.iterdir()) == []


def test_settings_out_of_range() -> None:
    with pytest.raises(ConfigError, match="--viewer-share"):
        TrainConfig(viewer_share=0)
    with pytest.raises(ConfigError, match=r"--viewer\.websocket-port"):
        ViewerConfig(websocket_port=0)
