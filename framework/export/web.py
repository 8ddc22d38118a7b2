"""A web page of a scene: one HTML file that opens from disk, offline, in any browser with WebGL 2.

The page (`page/`) is our own, requests nothing from any host, and holds the scene in base64 and facts about it as JSON.
Browsers without WebGL 2 show a still picture. A page of levels alone loads more, from the folder beside it.
Gaussians are an SPZ file (`framework/splats/spz.py`), drawn as `framework/kernels/splats/project.py` does. Octrees have
their own form (`octree_page.py`) and are drawn as `framework/kernels/octree/walk.h` does. All else is the same program.
"""

from __future__ import annotations

import base64
import binascii
import html
import io
import json
import re
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote, urljoin

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import nerfloom
from nerfloom.base.errors import ConfigError, DataError, FlagError
from nerfloom.base.evenly_spaced import strided
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import UP, looked_at, rotation_between
from nerfloom.evaluation.paths import arc_of
from nerfloom.splats.gaussian_limit import fitted_spz
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.spz import encoded, out_of_range, read_spz

MAX_MEGABYTES = 32.0
"""Maximum size of a page in millions of bytes; larger ones are refused by some phones."""
BITS = (8, 8)
"""Bits of harmonics where there is room: the page looks like the Gaussians to 55 dB, with SPZ's usual 5 and 4 to 41."""
MAX_CAMERAS = 300
"""Maximum number of the capture's cameras in a page, evenly spaced."""
PICTURE = (1200, 630)
"""Width and height of the picture of link previews, pixels, in the aspect ratio that most programs show."""
SCRIPTS = {
    "gaussians": ("unpack.js", "webgl.js", "splats.js", "measure.js", "motion.js", "viewer.js"),
    "levels": ("unpack.js", "webgl.js", "splats.js", "levels.js", "measure.js", "motion.js", "viewer.js"),
    "octree": ("unpack.js", "webgl.js", "octree.js", "measure.js", "motion.js", "viewer.js"),
}
"""Files of the program of each kind of page, in their order."""
STILL_SHARE, MAX_STILL = 0.05, 60_000
"""Share of a page's room that is left for the still picture, and the maximum size of its text, bytes."""
STILL_SIZES = ((600, 80), (600, 60), (400, 60), (200, 50))
"""Widths, pixels, and qualities of JPEG that are tried for it, one after the other."""
NO_STILL = 'src="data:,"'
"""The place of the still picture in a page."""
LEVEL = 0.5
"""The scene is turned if the cosine between z and the cameras' mean up direction is below this."""
DATA = re.compile(r'<script id="data" type="text/plain">([^<]*)</script>')
"""The scene in a page."""


@dataclass(frozen=True)
class PageFacts:
    """Facts that a page holds in addition to the scene."""

    title: str
    """Heading and title of the page."""
    about: str
    """Sentences for its help."""
    background: tuple[float, float, float]
    """Colour behind everything, 0 to 1."""
    near: float
    """Minimum depth of the centre of a drawn Gaussian, and minimum distance of drawn parts of an octree, scene
    units."""
    look: Look | None
    """How Gaussians are drawn; None for an octree."""
    focus: list[float]
    """Position x, y, z that the cameras look at, scene units."""
    cameras: list[list[Any]]
    """For each camera: name, the 12 numbers of its camera-to-scene pose (OpenGL axes, row by row), and fx, fy, cx, cy,
    width and height in pixels."""
    unit_length: float = 1.0
    """Length of a scene unit, in `unit`."""
    unit: str = ""
    """Name of the unit of lengths; empty for the input's unit."""
    relative_error: float | None = 0.0
    """Standard deviation of `unit_length`, as a fraction of it; None if it is not known."""
    arc: list[float] | None = None
    """Middle and width, radians from x towards y around `focus`, of the directions of a capture's photographs, if they
    do not go all around: where the page turns by itself. None for all around."""
    photographed: bool = True
    """Whether `cameras` belong to photographs, which determine how precise a length is."""
    start: int = 0
    """Number of the camera, of `cameras`, where the page starts."""
    url: str = ""
    """Address that the page will have; empty if unknown."""
    picture: str = ""
    """Name of a picture of PICTURE pixels beside the page, for link previews; empty for none."""
    levels: dict[str, Any] | None = None
    """The folder beside the page and the tree of its chunks (`levels_page.py`); None for a page of one file."""

    @property
    def kind(self) -> str:
        """The kind of the page, a key of `SCRIPTS`."""
        return "levels" if self.levels else "gaussians" if self.look else "octree"


def upright(cameras: Cameras, z_is_up: bool) -> Tensor:
    """Return the rotation (3, 3), float64, of the cameras' mean up direction to z.

    It is the identity if z is up already, or if the cameras are turned in all directions.

    Args:
        cameras: M cameras.
        z_is_up: whether z is known to be up, wherever the cameras' up is: they may look straight down, or lie on their
            side.
    """
    up = cameras.camera_to_worlds[:, :, 1].double().mean(0).cpu()
    if z_is_up or float(up.norm()) < LEVEL or float(up[2]) >= LEVEL * float(up.norm()):
        return torch.eye(3, dtype=torch.float64)
    return rotation_between(up, UP)


def held_upright(cameras: Cameras) -> Cameras:
    """Return cameras whose images are turned by quarters until z is up in them, as a photograph from a turned phone is.

    An image stays as it is if z is along none of its sides, as in a camera that looks straight down.

    Args:
        cameras: M pinhole cameras, in a frame with +z up.
    """
    poses = cameras.camera_to_worlds
    right, up = poses[:, :, 0], poses[:, :, 1]
    heights = torch.stack([up[:, 2], right[:, 2], -up[:, 2], -right[:, 2]], -1)
    quarters = torch.where(heights.amax(-1) >= LEVEL, heights.argmax(-1), 0)[:, None]
    # With 0, 1, 2 and 3 quarters, an image's new up is its old up, right, down and left.
    axes = torch.where(quarters % 2 == 0, right, -up), torch.where(quarters % 2 == 0, up, right)
    signs = torch.where(quarters < 2, 1, -1).to(poses)
    turned = torch.stack([signs * axes[0], signs * axes[1], poses[:, :, 2], poses[:, :, 3]], -1)
    lies, quarter = (quarters % 2 == 1)[:, 0], quarters[:, 0]
    across, down = cameras.widths - cameras.cx, cameras.heights - cameras.cy
    middle_x = torch.stack([cameras.cx, cameras.cy, across, down])
    middle_y = torch.stack([cameras.cy, across, down, cameras.cx])
    return replace(
        cameras,
        camera_to_worlds=turned,
        fx=torch.where(lies, cameras.fy, cameras.fx),
        fy=torch.where(lies, cameras.fx, cameras.fy),
        cx=middle_x.gather(0, quarter[None])[0],
        cy=middle_y.gather(0, quarter[None])[0],
        widths=torch.where(lies, cameras.heights, cameras.widths),
        heights=torch.where(lies, cameras.widths, cameras.heights),
    )


def pinhole(cameras: Cameras) -> Cameras:
    """Return pinhole cameras in the same places, which see about as much.

    Args:
        cameras: M cameras of any model with a centre of projection.

    Raises:
        ConfigError: if they have none.
    """
    if cameras.model == "orthographic":
        raise ConfigError("a web page draws in perspective, and this run's cameras are orthographic")
    if cameras.model == "equirectangular":  # a square with an opening of 90 degrees
        side = cameras.heights
        half = side / 2
        return replace(
            cameras, fx=half, fy=half, cx=half, cy=half, widths=side, heights=side, model="pinhole", lens=None
        )
    return replace(cameras, model="pinhole", lens=None)


def shown_cameras(count: int, start: int) -> list[int]:
    """Return the numbers of the cameras in a page: at most MAX_CAMERAS, evenly spaced, and `start` among them.

    Args:
        count: number of all cameras.
        start: number of the camera where the page starts.
    """
    chosen = strided(count, MAX_CAMERAS)
    nearest = min(range(len(chosen)), key=lambda rank: abs(chosen[rank] - start))
    chosen[nearest] = start
    return chosen


def camera_rows(cameras: Cameras, names: Sequence[str], turn: Tensor) -> list[list[Any]]:
    """Return the rows of `PageFacts.cameras`.

    Args:
        cameras: M pinhole cameras.
        names: M names of their images.
        turn: (3, 3) rotation of the scene.
    """
    poses = turn @ cameras.camera_to_worlds.double().cpu()
    lenses = torch.stack([getattr(cameras, k).double() for k in ("fx", "fy", "cx", "cy", "widths", "heights")], -1)
    rows = []
    for index in range(len(cameras)):
        pose = [round(value, 7) for value in poses[index].flatten().tolist()]
        rows.append([names[index], pose, [round(value, 4) for value in lenses[index].tolist()]])
    return rows


def focus_of(cameras: Cameras, turn: Tensor) -> list[float]:
    """Return the position that cameras look at: nearest to all their axes, and in front of most of them.

    Args:
        cameras: M cameras.
        turn: (3, 3) rotation of the scene.
    """
    point = looked_at(cameras.camera_to_worlds)
    if point is None:
        poses = cameras.camera_to_worlds.double().cpu()
        centers, forward = poses[:, :, 3], -poses[:, :, 2]
        size = float((centers - centers.mean(0)).norm(dim=-1).max()) or 1.0
        point = centers.mean(0) + size * forward.mean(0)
    return [round(value, 6) for value in (turn @ point).tolist()]


def turning_arc(cameras: Cameras, focus: Sequence[float], turn: Tensor) -> list[float] | None:
    """Return the value of `PageFacts.arc` for the cameras of a capture.

    Args:
        cameras: M cameras.
        focus: position x, y, z that they look at, in the turned frame.
        turn: (3, 3) rotation of the scene.
    """
    poses = (turn @ cameras.camera_to_worlds.double().cpu()).float()
    arc = arc_of(replace(cameras, camera_to_worlds=poses), torch.tensor(focus))
    return None if arc is None else [round(arc.middle, 6), round(arc.width, 6)]


def make_page(gaussians: Gaussians, facts: PageFacts, max_megabytes: float) -> tuple[str, list[str]]:
    """Return a web page of Gaussians of limited size, and sentences about parts removed to fit it.

    Args:
        gaussians: N Gaussians on the CPU, in a frame where z is up.
        facts: further data of the page.
        max_megabytes: maximum size of the page, in millions of bytes.

    Raises:
        ConfigError: if the limit is above MAX_MEGABYTES, or no Gaussian fits.
        ValueError: if `facts` do not say how Gaussians are drawn.
    """
    if facts.look is None:
        raise ValueError("a page of Gaussians says how they are drawn")
    most = room(facts, max_megabytes)
    payload, lost, changes = encoded(gaussians, BITS, facts.look), out_of_range(gaussians), ""
    if len(payload) > most:
        payload, lost, changes = fitted_spz(gaussians, most, facts.look)
        changes = changes or "harmonics in 5 and 4 bits instead of 8"
    return page(payload, facts), [f"{max_megabytes:g} MB hold {changes}", *lost] if changes else lost


def room(facts: PageFacts, max_megabytes: float) -> float:
    """Return the number of bytes that a page has for its scene.

    Args:
        facts: further data of the page.
        max_megabytes: maximum size of the page, in millions of bytes.

    Raises:
        ConfigError: if the limit is above MAX_MEGABYTES.
    """
    check_size(max_megabytes)
    free = 1e6 * max_megabytes - len(page(b"", facts).encode())
    return (free - min(STILL_SHARE * free, MAX_STILL)) // 4 * 3


def with_still(text: str, picture: np.ndarray, max_megabytes: float) -> str:
    """Return a page with a still picture, which browsers show until the scene is drawn, or if they cannot draw it.

    Args:
        text: content of a page without one.
        picture: (H, W, 3) uint8 picture of the start view.
        max_megabytes: maximum size of the page, in millions of bytes; it stays as it is if no picture fits.
    """
    most = min(1e6 * max_megabytes - len(text.encode("utf-8", "replace")), MAX_STILL)
    for width, quality in STILL_SIZES:
        content = io.BytesIO()
        small = Image.fromarray(picture)
        small.thumbnail((width, width))
        small.save(content, "JPEG", quality=quality)
        address = f'src="data:image/jpeg;base64,{base64.b64encode(content.getvalue()).decode()}"'
        if len(address) <= most:
            return text.replace(NO_STILL, address, 1)
    return text


def check_size(max_megabytes: float) -> None:
    """Check the limit of a page's size.

    Args:
        max_megabytes: the limit, in millions of bytes.

    Raises:
        ConfigError: if it is not positive, or above MAX_MEGABYTES.
    """
    if not 0 < max_megabytes <= MAX_MEGABYTES:
        raise FlagError(
            f"--max-megabytes is {max_megabytes:g}; a page has up to {MAX_MEGABYTES:g}, since phones refuse larger ones"
        )


def page(payload: bytes, facts: PageFacts) -> str:
    """Return the page of a scene.

    Args:
        payload: content of its SPZ file, or of an octree (`octree_page.py`).
        facts: further data of the page.
    """
    folder = files("nerfloom.export") / "page"
    plain = json.dumps(asdict(facts), separators=(",", ":"), allow_nan=False)
    parts = {
        "title": html.escape(facts.title),
        "about": html.escape(facts.about),
        "lengths": html.escape(f"lengths are in {facts.unit or 'the unit of the input'}"),
        "preview": preview_tags(facts),
        "requests": "; connect-src 'self'" if facts.levels else "",
        "version": html.escape(nerfloom.__version__),
        "style": (folder / "viewer.css").read_text(encoding="utf-8"),
        "script": "".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS[facts.kind]),
        "facts": plain.replace("<", "\\u003c"),  # no name ends the element
        "data": base64.b64encode(payload).decode(),
    }
    template = (folder / "viewer.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], template)


def preview_tags(facts: PageFacts) -> str:
    """Return the elements of a page's head that link previews read, in the Open Graph protocol (https://ogp.me).

    Args:
        facts: data of the page. Without `url`, the picture's address is relative, which some programs do not follow.
    """
    width, height = PICTURE
    tags = {"og:type": "website", "og:title": facts.title, "og:description": facts.about}
    if facts.url:
        tags["og:url"] = facts.url
    if facts.picture:
        address = urljoin(facts.url, quote(facts.picture, errors="surrogateescape"))
        tags |= {"og:image": address, "og:image:width": str(width)}
        tags |= {"og:image:height": str(height), "og:image:alt": facts.title}
    lines = [f'<meta property="{name}" content="{html.escape(value)}">' for name, value in tags.items()]
    card = "summary_large_image" if facts.picture else "summary"
    return "\n".join([*lines, f'<meta name="twitter:card" content="{card}">'])


def payload_of(text: str) -> bytes:
    """Return the scene in a page, as given to `page`.

    Args:
        text: content of the page.

    Raises:
        DataError: if there is none.
    """
    found = DATA.search(text)
    try:
        return base64.b64decode(found[1], validate=True) if found else b""
    except (binascii.Error, ValueError) as error:
        raise DataError("the page's data are damaged; export it again") from error


def gaussians_of(text: str) -> Gaussians:
    """Return the Gaussians in a page of Gaussians, as they are drawn there.

    Args:
        text: content of the page.

    Raises:
        DataError: if there are none, or they are damaged.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "page.spz"
        file.write_bytes(payload_of(text))
        return read_spz(file).gaussians
