"""The server, met by clients that speak its protocol, by clients that do not, and by pages from elsewhere."""

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.view import View
from nerfloom.geometry.regions import Box, read_regions
from nerfloom.training.datasets import load_split
from nerfloom.training.run import create_folder
from nerfloom.training.trainer import Trainer
from nerfloom.viewer.page import Page
from nerfloom.viewer.photographs import Photographs
from nerfloom.viewer.render_queue import RenderQueue
from nerfloom.viewer.request import pose_of, quaternion_of
from nerfloom.viewer.server import addresses, free_port, is_allowed
from nerfloom.viewer.training_viewer import in_training
from tests.training.helpers import tiny_run

pytest.importorskip("viser", reason="the extra [viewer] is not installed")

from nerfloom.viewer.server import close_server, open_server
from tests.patience import until
from tests.viewer.client import LOOK, Client

FROM_THE_SIDE: dict[str, Any] = {"position": (0.0, -4.0, 0.0), "wxyz": (0.5**0.5, -(0.5**0.5), 0.0, 0.0)}
"""A camera that looks along y, with z up in its picture."""


class Served:
    """A viewer of a tiny trained model that draws pictures in a thread of its own."""

    def __init__(self, folder: Path, data: Path) -> None:
        run = tiny_run("instant-ngp", data, folder, max_num_iterations=60)
        create_folder(run)
        trainer = Trainer.of(run, load_split(run, "train"))
        for _ in range(60):
            trainer.train_step()
        self.photographs = Photographs(run, lambda: trainer.model)
        self.queue = RenderQueue(in_training(run, trainer), truth=self.photographs.truth)
        self.folder, self.data, self.model = folder, data, trainer.model
        self._server = open_server("127.0.0.1", 17007)
        self.port = self._server.get_port()
        self.page = Page(self._server, self.queue, self.photographs, commands=None)
        self._ending = False
        self._thread = threading.Thread(target=self._draw)
        self._thread.start()

    def _draw(self) -> None:
        while not self._ending:
            if self.queue.draw_next() is None:
                self.queue.wait(0.01)

    def rests(self) -> bool:
        """Whether every browser has the finished picture of its last request."""
        browsers, now = list(self.queue._browsers.values()), time.monotonic()
        waiting = [browser.waiting(self.queue.loaded.step, now) for browser in browsers]
        return not any(one.new or one.rough for one in waiting)

    def close(self) -> None:
        self._ending = True
        self._thread.join()
        self.page.close()
        close_server(self._server)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, shared_tiny: Path) -> Iterator[Served]:
    viewer = Served(tmp_path_factory.mktemp("served") / "run", shared_tiny)
    yield viewer
    viewer.close()


@pytest.fixture
def connected(served: Served) -> Iterator[Callable[..., Client]]:
    clients = []

    def connect(**how: Any) -> Client:
        clients.append(Client(served.port, served.rests, **how))
        return clients[-1]

    yield connect
    for client in clients:
        client.close()


def truth(served: Served, longest: int, **changes: Any) -> np.ndarray:
    """The model itself rendered from the client's camera."""
    look = {**LOOK, **changes}
    pose = pose_of(look["wxyz"], look["position"], look["fov"])
    assert pose is not None
    from nerfloom.viewer.request import Request

    request = Request(pose, longest, longest * look["image_height"] // look["image_width"])
    picture = served.model.render_view(View(request.camera()), served.model.background)
    return picture.rgb.numpy() * 255


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.square(a.astype(float) - b).mean()))


@pytest.mark.medium
def test_the_picture_is_the_models(served: Served, connected: Callable[..., Client]) -> None:
    client = connected()
    client.look()
    found = client.finished()
    assert found.shape == (60, 80, 3)
    assert decibels(found, truth(served, 80)) > 35  # JPEG
    client.look(position=(0.5, 0.0, -3.0))
    found = client.finished()
    assert decibels(found, truth(served, 80, position=(0.5, 0.0, -3.0))) > 35
    assert decibels(found, truth(served, 80)) < 25


@pytest.mark.medium
def test_two_browsers_see_what_each_asks_for(served: Served, connected: Callable[..., Client]) -> None:
    first, second = connected(), connected()
    first.look()
    second.look(position=(0.0, 0.0, -3.0))
    first.finished()
    second.finished()
    second.set("Output", "depth")
    depth = second.finished()
    with pytest.raises(TimeoutError):
        first.picture(0.5)  # its output is its own
    assert decibels(depth, truth(served, 80, position=(0.0, 0.0, -3.0))) < 25
    first.look(position=(0.0, 0.5, -4.0))
    assert decibels(first.finished(), truth(served, 80, position=(0.0, 0.5, -4.0))) > 35


@pytest.mark.medium
def test_controls_that_send_nonsense(served: Served, connected: Callable[..., Client]) -> None:
    client = connected()
    client.look()
    client.finished()
    for value in ("nonsense", None, [1, 2], float("nan"), {"a": 1}, "../../etc/passwd"):
        for label in ("Output", "Resolution", "Own colour", "Colour", "Crop", "Lowest corner", "Near"):
            client.set(label, value)
    client.look(position=(float("nan"), 0.0, 0.0))
    client.look(wxyz=(0.0, 0.0, 0.0, 0.0))
    client.look(fov="wide")
    client.look(image_width=-5)
    other = connected()
    other.look()
    assert decibels(other.finished(), truth(served, 80)) > 35


def test_a_crop_box_leaves_the_background(served: Served, connected: Callable[..., Client]) -> None:
    client = connected()
    client.look()
    client.finished()
    client.set("Lowest corner", [5.0, 5.0, 5.0])
    client.set("Highest corner", [6.0, 6.0, 6.0])
    client.set("Crop", True)
    assert client.finished().min() > 250  # white


@pytest.mark.medium
def test_an_arrow_moves_a_face_of_the_box_and_the_file_is_the_region(
    served: Served, connected: Callable[..., Client]
) -> None:
    """The box that arrows have made cuts the picture as the same numbers do, and its file is a region of exports."""
    client, typed = connected(), connected()
    for one in (client, typed):
        one.look(**FROM_THE_SIDE)
        whole = one.finished()
        one.set("Crop", True)
    low, high = served.model.scene.box.double().tolist()
    arrow = client.message("TransformControlsMessage", name="/crop/z1")
    assert arrow["props"]["active_axes"] == [False, False, True]
    drag = {"name": "/crop/z1", "owner": arrow["owner"]}
    move = {**drag, "type": "TransformControlsUpdateMessage", "wxyz": (1.0, 0.0, 0.0, 0.0)}
    client.send({**drag, "type": "TransformControlsDragStartMessage"})
    client.send({**move, "position": [float("nan")] * 3})
    client.send({**move, "position": (0.0, 0.0, low[2] - 5.0)})  # beyond the opposite face
    client.send({**move, "position": (0.0, 0.0, 0.25)})
    client.send({**drag, "type": "TransformControlsDragEndMessage"})
    typed.set("Highest corner", [*high[:2], 0.25])
    cut = client.finished()
    assert np.abs(cut.astype(int) - typed.finished()).max() < 8
    assert decibels(cut, whole) < 25
    client.set("Save the crop", True)
    file = served.folder / "crop.yaml"
    until(file.is_file)
    (found,), placement = read_regions(file), served.queue.loaded.placement
    assert isinstance(found, Box)
    ends = placement.points(torch.tensor([found.low, found.high]))  # the tiny data set is placed without a rotation
    np.testing.assert_allclose(ends, [low, [*high[:2], 0.25]], atol=1e-6)


def select(client: Client, kind: str, *places: tuple[float, float]) -> None:
    """Draw a rectangle, or click one corner of an outline."""
    message = {"type": "ScenePointerMessage", "event_type": kind, "screen_pos": places, "modifier": None}
    ray = (0.0, 0.0, 0.0) if kind == "click" else None
    client.send({**message, "ray_origin": ray, "ray_direction": ray})


@pytest.mark.medium
def test_selections_are_kept_removed_undone_and_saved(served: Served, connected: Callable[..., Client]) -> None:
    """A rectangle in the picture of its own camera, an outline from another one, and the regions of their file."""
    client = connected()
    client.look()
    whole = client.finished().astype(int)
    inside = np.zeros((60, 80), bool)
    inside[15:45, 20:48] = True
    edge = binary_dilation(inside, iterations=9) & ~binary_erosion(inside, iterations=9)  # JPEG's blocks
    assert (np.abs(whole - 255).max(-1) > 40)[inside].mean() > 0.5
    client.set("Keep inside", True)  # there is none
    client.set("Draw a rectangle", True)
    select(client, "rect-select", (0.3, 0.3), (0.3, 0.3))
    select(client, "rect-select", (float("nan"), 0.25), (0.25, 0.1))
    select(client, "rect-select", (0.25, 0.25), (0.6, 0.75))
    client.set("Remove inside", True)
    removed = client.finished().astype(int)
    assert (removed[inside & ~edge] > 245).all()
    assert np.abs(removed - whole)[~inside & ~edge].max() < 12
    client.set("Undo", True)
    assert np.abs(client.finished() - whole).max() < 12
    select(client, "rect-select", (0.1, 0.1), (0.9, 0.9))  # nothing takes it
    client.set("Draw a rectangle", True)
    select(client, "rect-select", (0.25, 0.25), (0.6, 0.75))
    client.set("Keep inside", True)
    kept = client.finished().astype(int)
    assert (kept[~inside & ~edge] > 245).all()
    assert np.abs(kept - whole)[inside & ~edge].max() < 12
    client.look(**FROM_THE_SIDE)
    from_the_side = client.finished()
    client.set("Draw an outline", True)
    for place in ((0.1, 0.1), (0.9, 0.1), (0.5, 0.6)):
        select(client, "click", place)
    client.set("Remove inside", True)
    assert decibels(client.finished(), from_the_side) < 30
    file = served.folder / "crop.yaml"
    file.unlink(missing_ok=True)  # of another test
    client.set("Save the crop", True)
    until(file.is_file)
    first, second = read_regions(file)
    file.unlink()
    scene = 6 * torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 3
    points = served.queue.loaded.placement.original_points(scene)
    x, y, z = scene.numpy().T  # both cameras have a focal length of 30 / tan(0.35) pixels; see `LOOK`
    column, row = (40 + 30 / np.tan(0.35) * x / (z + 4)) / 80, (30 + 30 / np.tan(0.35) * y / (z + 4)) / 60
    truth = (z > -4) & (np.abs(column - 0.425) < 0.175) & (np.abs(row - 0.5) < 0.25)
    np.testing.assert_array_equal(first.contains(points), truth)
    column, row = (40 + 30 / np.tan(0.35) * x / (y + 4)) / 80, (30 - 30 / np.tan(0.35) * z / (y + 4)) / 60
    across, down = np.abs(column - 0.5) / 0.4, (row - 0.1) / 0.5
    np.testing.assert_array_equal(second.contains(points), ~((y > -4) & (down > 0) & (across + down < 1)))
    client.set("Undo", True)
    assert np.abs(client.finished().astype(int) - from_the_side).max() < 12


@pytest.mark.medium
def test_the_camera_is_levelled_and_its_field_of_view_set(served: Served, connected: Callable[..., Client]) -> None:
    client = connected()
    client.look(**FROM_THE_SIDE, up_direction=(0.3, 0.1, 0.9))
    client.finished()
    client.set("Level", True)
    assert client.message("SetCameraUpDirectionMessage", initial=False)["position"] == pytest.approx([0, 0, 1])
    client.set("Up", "-x")
    assert client.message("SetCameraUpDirectionMessage", initial=False)["position"] == pytest.approx([-1, 0, 0])
    client.set("Field of view", 80.0)
    assert client.message("SetCameraFovMessage", initial=False)["fov"] == pytest.approx(math.radians(80))
    client.set("Field of view", 1e9)
    assert client.message("SetCameraFovMessage", initial=False)["fov"] == pytest.approx(math.radians(140))


@pytest.mark.medium
def test_keys(served: Served, connected: Callable[..., Client]) -> None:
    client = connected()
    client.look()
    whole = client.finished()

    def press(label: str) -> None:
        client.send({"type": "CommandTriggerMessage", "uuid": client.controls[label][0]})

    press("Next output")
    assert decibels(client.finished(), whole) < 25  # depth
    client.set("Output", "rgb")
    client.finished()
    press("Next photograph")
    pose = served.photographs.pose(1)
    assert client.message("SetCameraPositionMessage", initial=False)["position"] == pytest.approx(pose[:, 3].tolist())


@pytest.mark.medium
def test_a_photograph_lies_over_the_picture(served: Served, connected: Callable[..., Client]) -> None:
    """It does so at the pose of a photograph; from elsewhere the picture is the model's alone."""
    client, pose = connected(), served.photographs.pose(3)
    where = {"wxyz": quaternion_of(pose), "position": tuple(pose[:, 3].tolist()), "fov": served.photographs.fov(3)}
    client.look(**where, image_width=60)
    model = client.finished()
    client.set("Overlay", 1.0)
    rgba = iio.imread(served.data / "train" / "r_3.png").astype(float)
    photograph = rgba[..., :3] * rgba[..., 3:] / 255 + 255 - rgba[..., 3:]
    small = torch.from_numpy(photograph).permute(2, 0, 1)[None]
    large = torch.nn.functional.interpolate(small, (60, 60), mode="bilinear")[0].permute(1, 2, 0).numpy()
    assert decibels(client.finished(), large) > 30
    client.set("Overlay", 0.5)
    assert decibels(client.finished(), (large + model) / 2) > 30
    client.look(position=(0.0, 0.5, -4.0))
    assert decibels(client.finished(), truth(served, 80, position=(0.0, 0.5, -4.0))) > 35


def test_garbage_on_the_socket(served: Served, connected: Callable[..., Client]) -> None:
    for content in (b"\xff" * 100, b"", b"\x93\x01\x02\x03", b"GET /../../etc/passwd HTTP/1.1\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", served.port)) as raw:
            raw.sendall(content)
    client = connected()
    client.socket.send("text, where bytes belong")
    client = connected()
    client.socket.send(b"\xc1garbage")
    client = connected()
    client.send({"type": "NoSuchMessage"})
    client = connected()
    client.send({"type": "GuiUpdateMessage", "uuid": 5, "updates": 7})
    client.send({"type": "ShareUrlRequest"})  # the viewer is not made public
    leaving = connected()
    leaving.look()
    leaving.socket.socket.close()  # in the middle, without a farewell
    client = connected()
    client.look()
    assert decibels(client.finished(), truth(served, 80)) > 35
    until(lambda: len(served.page._panels) <= 2)  # browsers that have left are forgotten


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "http://localhost.evil.com"])
def test_other_pages_are_refused(served: Served, connected: Callable[..., Client], origin: str) -> None:
    client = connected(origin=origin)
    with pytest.raises(Exception, match=r"1008|only the viewer's own page"):
        client.messages(10)


def test_the_viewers_own_page_may_connect(served: Served, connected: Callable[..., Client]) -> None:
    client = connected(origin=f"http://127.0.0.1:{served.port}")
    client.look()
    assert decibels(client.finished(), truth(served, 80)) > 35


def test_origins() -> None:
    assert is_allowed(None, "127.0.0.1:7007", True)
    assert is_allowed("http://127.0.0.1:7007", "127.0.0.1:7007", True)
    assert not is_allowed("http://127.0.0.1:7008", "127.0.0.1:7007", True)
    assert not is_allowed("http://evil.example:7007", "evil.example:7007", True)  # its name made to mean 127.0.0.1
    assert is_allowed("http://machine:7007", "machine:7007", False)
    assert not is_allowed("file://", "127.0.0.1:7007", True)


def test_the_address_that_is_said_can_be_opened() -> None:
    assert addresses("127.0.0.1", 7007) == "http://127.0.0.1:7007"
    assert addresses("::1", 7008) == "http://[::1]:7008"
    for host in ("0.0.0.0", "::"):
        here, others = addresses(host, 7007).split(" (from other machines: ")
        assert here == "http://localhost:7007"
        assert others == f"http://{socket.gethostname()}:7007)"


def test_ports() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) <= port + 100
    for host, port in (("127.0.0.1", 0), ("127.0.0.1", 70_000), ("203.0.113.7", 7007), ("no such host", 7007)):
        with pytest.raises(ConfigError, match="--websocket"):
            free_port(host, port)
