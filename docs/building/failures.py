"""Pictures of captures that go wrong, for the guide: the embedded scene with one fault each, and with the remedy.

    python docs/building/failures.py                      all of them, into docs/pictures/failures
    python docs/building/failures.py blur poses           some of them
    python docs/building/failures.py --steps 2000

Each picture shows a photograph of the faulty capture, a held-out view of nerfacto's result, the same view with the
remedy, and the truth. PSNRs of the held-out views are printed and written beside the pictures. The scene is
ours, so that the pictures may be shipped. Behind the solids is a pattern at infinity; a plain wall would be a fault of
its own.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read when torch loads: threads that wait should not spin

import imageio.v3 as iio
import numpy as np
import torch
from PIL import Image
from torch.nn.functional import grid_sample

import nerfloom
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE, camera_poses, render_view
from nerfloom.kernels.math import cross_matrix

SIZE, NUM_TRAIN, NUM_TEST = 128, 48, 6
TILE = 200
"""Edge of a tile of the pictures, pixels."""
BALL = 0.35
"""Radius of the balloon of `motion`, scene units."""
K1, MARGIN = -0.45, 14
"""Coefficient of the wide lens, and by how many pixels more it sees on each side than a pinhole."""
Photographs = list[np.ndarray]
"""(SIZE, SIZE, 3) float in [0, 1] each."""


@dataclass
class Capture:
    """Photographs with poses, and masks if there are any: white is kept."""

    images: Photographs
    poses: list[np.ndarray]
    masks: list[np.ndarray] | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the run that learns from it."""
    lens: dict[str, Any] = field(default_factory=dict)
    """Lens of the photographs in transforms.json; empty for a pinhole."""

    def write(self, folder: Path, truth: Capture) -> None:
        """Write nerfstudio's transforms.json, with the images of `truth` held out."""
        frames: list[dict[str, Any]] = []
        names: dict[str, list[str]] = {"train": [], "test": []}
        for split, capture in (("train", self), ("test", truth)):
            for index, (image, pose) in enumerate(zip(capture.images, capture.poses, strict=True)):
                name = f"images/{split}_{index:03d}.png"
                write(folder / name, image)
                frame: dict[str, Any] = {"file_path": name, "transform_matrix": pose.tolist(), **capture.lens}
                if split == "train" and self.masks is not None:
                    frame["mask_path"] = f"masks/{index:03d}.png"
                    write(folder / frame["mask_path"], self.masks[index].astype(float))
                frames.append(frame)
                names[split].append(name)
        content = {"camera_model": "OPENCV", "fl_x": focal(), "fl_y": focal(), "cx": SIZE / 2, "cy": SIZE / 2}
        content |= {"w": SIZE, "h": SIZE, "frames": frames}
        content |= {"train_filenames": names["train"], "val_filenames": names["test"], "test_filenames": names["test"]}
        (folder / "transforms.json").write_text(json.dumps(content))


def focal() -> float:
    """Return the focal length in pixels."""
    return 0.5 * SIZE / math.tan(CAMERA_ANGLE / 2)


def write(path: Path, image: np.ndarray) -> None:
    """Write an image with values in [0, 1]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, (image * 255).round().clip(0, 255).astype(np.uint8))


def placed(split: str, count: int, nearer: float = 1.0) -> list[np.ndarray]:
    """Return poses (4, 4) of cameras around the scene, at `nearer` times the usual distance."""
    scale = np.ones((4, 4))
    scale[:3, 3] = nearer
    return [pose * scale for pose in camera_poses(split, count, 0)]


@functools.cache
def taken(split: str, count: int, index: int, nearer: float, margin: int) -> np.ndarray:
    """Return a view of the scene alone, with alpha; kept, since several captures begin with it.

    Its edge is SIZE and `margin` pixels more on each side, seen by the same focal length.
    """
    pose, size = placed(split, count, nearer)[index], SIZE + 2 * margin
    return render_view(pose, 2 * math.atan(0.5 * size / focal()), size, size, supersample=2, geometry=False)[0] / 255.0


def photograph(
    split: str, count: int, index: int, plain: bool = False, nearer: float = 1.0, margin: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return a photograph of the scene, and its alpha (H, W), before a pattern at infinity or a plain white."""
    rgba, pose = taken(split, count, index, nearer, margin), placed(split, count, nearer)[index]
    alpha = rgba[..., 3:]
    behind = 1.0 if plain else pattern(directions(pose, margin))
    return rgba[..., :3] * alpha + behind * (1 - alpha), alpha[..., 0]


def directions(pose: np.ndarray, margin: int = 0) -> np.ndarray:
    """Return the unit direction of each pixel's ray (H, W, 3)."""
    size = SIZE + 2 * margin
    rows, columns = (np.mgrid[:size, :size] + 0.5 - size / 2) / focal()
    rays = np.stack([columns, -rows, -np.ones_like(rows)], -1) @ pose[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def pattern(rays: np.ndarray) -> np.ndarray:
    """Return colours of directions: soft patches of different colours and sizes."""
    waves = [np.sin(9 * rays @ axis) + np.sin(23 * rays @ axis[::-1] + 1) for axis in np.eye(3) + 0.3]
    return 0.55 + 0.12 * np.stack(waves, -1)


def still() -> Capture:
    """Return a capture without a fault."""
    poses = placed("train", NUM_TRAIN)
    return Capture([photograph("train", NUM_TRAIN, index)[0] for index in range(NUM_TRAIN)], poses)


def blur() -> tuple[Capture, Capture]:
    """Half of the photographs were taken in motion; what helps is to leave them out."""
    good = still()
    blurred = [np.mean([np.roll(image, shift, axis=1) for shift in range(-6, 7)], axis=0) for image in good.images]
    mixed = [(blurred, good.images)[index % 2][index] for index in range(NUM_TRAIN)]
    sharp = {"train_image_indices": tuple(range(1, NUM_TRAIN, 2))}
    return Capture(mixed, good.poses), Capture(mixed, good.poses, settings=sharp)


def exposure() -> tuple[Capture, Capture]:
    """Exposure differs by up to a stop either way; what helps is an appearance for each photograph."""
    good, stops = still(), np.random.default_rng(0).uniform(-1, 1, NUM_TRAIN)
    images = [(image * 2.0 ** (0.45 * stop)).clip(0, 1) for image, stop in zip(good.images, stops, strict=True)]
    return (
        Capture(images, good.poses, settings={"appearance": "none"}),
        Capture(images, good.poses, settings={"appearance": "vector"}),
    )


def balloon(pose: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a violet ball at `place` as a camera sees it: colour (SIZE, SIZE, 3), and where it is, (SIZE, SIZE)."""
    rays = directions(pose)
    along = rays @ (place - pose[:3, 3])
    nearest = pose[:3, 3] + along[..., None] * rays - place
    inside = np.clip(1 - (nearest**2).sum(-1) / BALL**2, 0, None)
    return np.array([0.6, 0.2, 0.8]) * (0.4 + 0.6 * np.sqrt(inside))[..., None], inside > 0


def motion() -> tuple[Capture, Capture]:
    """A balloon drifts between camera and scene, in two of three photographs; what helps is to mask it."""
    good, random = still(), np.random.default_rng(0)
    images, masks = [], []
    for index, (image, pose) in enumerate(zip(good.images, good.poses, strict=True)):
        place = 0.45 * pose[:3, 3] + random.uniform(-0.4, 0.4, 3)
        colour, covered = balloon(pose, place)
        covered &= index % 3 < 2
        images.append(np.where(covered[..., None], colour, image))
        masks.append(~covered)
    return Capture(images, good.poses), Capture(images, good.poses, masks, {"masks": "ignored"})


def few() -> tuple[Capture, Capture]:
    """There are six photographs; what helps is more of them."""
    good = still()
    return Capture(good.images[:6], good.poses[:6]), good


def poses() -> tuple[Capture, Capture]:
    """Each camera is turned by 1.5 degrees; what helps is to refine the poses."""
    good, random = still(), np.random.default_rng(0)
    wrong = []
    for pose in good.poses:
        axis = random.normal(size=3)
        turn = torch.linalg.matrix_exp(cross_matrix(torch.tensor(math.radians(1.5) * axis / np.linalg.norm(axis))))
        wrong.append(np.vstack([np.hstack([turn.numpy() @ pose[:3, :3], pose[:3, 3:]]), [[0, 0, 0, 1]]]))
    return (
        Capture(good.images, wrong, settings={"camera_optimizer": "off"}),
        Capture(good.images, wrong, settings={"camera_optimizer": "SO3xR3"}),
    )


def texture() -> tuple[Capture, Capture]:
    """The surroundings are plain white, and held-out views come nearer; what helps is to cut the object out."""
    where = placed("train", NUM_TRAIN)
    shown = [photograph("train", NUM_TRAIN, index, plain=True) for index in range(NUM_TRAIN)]
    images, masks = [image for image, _ in shown], [alpha > 0.5 for _, alpha in shown]
    return Capture(images, where), Capture(images, where, masks, {"masks": "empty", "background": "white"})


def cutout() -> tuple[Capture, Capture]:
    """Masks cut the object out, and what they hide is taken for unknown; what helps is to take it for empty."""
    shown, where = [photograph("train", NUM_TRAIN, index) for index in range(NUM_TRAIN)], placed("train", NUM_TRAIN)
    images, masks = [image for image, _ in shown], [alpha > 0.5 for _, alpha in shown]
    unknown, empty = ({"masks": name, "background": "white"} for name in ("ignored", "empty"))
    return Capture(images, where, masks, unknown), Capture(images, where, masks, empty)


def repeats() -> tuple[Capture, Capture]:
    """Cameras of one half of the circle are taken for opposite ones; what helps are the right poses."""
    good, half_a_turn = still(), np.diag([-1.0, -1.0, 1.0, 1.0])
    folded = [pose if pose[1, 3] >= 0 else half_a_turn @ pose for pose in good.poses]
    return Capture(good.images, folded), good


def pinhole_of(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a point's position in a pinhole's image, from its position x, y in a lens with K1, at a distance of 1."""
    wide_x, wide_y = x, y
    for _ in range(50):  # each step leaves less than half of the error
        scale = 1 + K1 * (wide_x**2 + wide_y**2)
        wide_x, wide_y = x / scale, y / scale
    return wide_x, wide_y


def lens() -> tuple[Capture, Capture]:
    """A wide lens bends lines, and is taken for a pinhole; what helps is to say which lens it is."""
    images, half = [], SIZE / 2 + MARGIN
    rows, columns = (np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2) / focal()
    grid = np.stack(pinhole_of(columns, rows), -1) * focal() / half  # where it is in the wider image, in [-1, 1]
    for index in range(NUM_TRAIN):
        wider = torch.from_numpy(photograph("train", NUM_TRAIN, index, margin=MARGIN)[0]).permute(2, 0, 1)[None]
        seen = grid_sample(wider, torch.from_numpy(grid)[None], align_corners=False)
        images.append(seen[0].permute(1, 2, 0).numpy())
    where = placed("train", NUM_TRAIN)
    return Capture(images, where), Capture(images, where, lens={"k1": K1})


KINDS: dict[str, Callable[[], tuple[Capture, Capture]]] = {
    "blur": blur, "exposure": exposure, "motion": motion, "few": few, "poses": poses, "texture": texture,
    "cutout": cutout, "repeats": repeats, "lens": lens,
}  # fmt: skip
ON_WHITE = ("texture", "cutout")
"""Kinds with held-out views that have plain white behind the scene."""


def learn(capture: Capture, truth: Capture, steps: int, folder: Path) -> tuple[np.ndarray, float]:
    """Return a held-out view as `nerfacto` renders it after some steps, and the mean PSNR of all held-out views, dB."""
    capture.write(folder / "data", truth)
    settings: dict[str, Any] = {
        "max_num_iterations": steps,
        "num_rays_per_batch": 1024,
        "output_dir": str(folder),
        "vis": "none",
    }
    settings |= {"steps_per_eval_image": steps, "steps_per_eval_all_images": steps, "max_eval_images": 1}
    run = nerfloom.train("nerfacto", data=folder / "data", **settings, **capture.settings)
    rgb = [run.render(view).rgb.clamp(0, 1).numpy() for view in run.views("test")]
    errors = [np.mean((found - image) ** 2) for found, image in zip(rgb, truth.images, strict=True)]
    return rgb[1], float(np.mean([-10 * np.log10(error) for error in errors]))


def tile(image: np.ndarray) -> Image.Image:
    """Return a tile of a picture, for an image with values in [0, 1]."""
    picture = Image.fromarray((image * 255).round().clip(0, 255).astype(np.uint8))
    return picture.resize((TILE, TILE), Image.Resampling.BICUBIC)


def draw(kind: str, steps: int, folder: Path) -> dict[str, float]:
    """Train on the faulty capture and with the remedy, write the picture, and return the PSNRs of both."""
    faulty, helped = KINDS[kind]()
    plain, nearer = kind in ON_WHITE, 0.65 if kind == "texture" else 1.0
    where = placed("test", NUM_TEST, nearer)
    views = [photograph("test", NUM_TEST, index, plain, nearer)[0] for index in range(NUM_TEST)]
    truth = Capture(views, where)
    with tempfile.TemporaryDirectory() as temporary:
        results = [learn(c, truth, steps, Path(temporary) / n) for n, c in (("faulty", faulty), ("helped", helped))]
    row = Image.new("RGB", (4 * TILE + 3 * 4, TILE), "white")
    for index, image in enumerate([faulty.images[0], results[0][0], results[1][0], truth.images[1]]):
        row.paste(tile(image), (index * (TILE + 4), 0))
    folder.mkdir(parents=True, exist_ok=True)
    row.save(folder / f"{kind}.jpg", quality=88)
    return {"faulty": round(results[0][1], 2), "helped": round(results[1][1], 2)}


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", help=f"which of {', '.join(KINDS)}; all if none is named")
    parser.add_argument("--steps", type=int, default=400, help="training steps of each run")
    parser.add_argument("--folder", type=Path, default=Path(__file__).parents[1] / "pictures" / "failures")
    flags = parser.parse_args()
    results = flags.folder / "psnr.json"
    found = json.loads(results.read_text())["psnr"] if results.is_file() else {}
    for kind in flags.kinds or KINDS:
        found[kind] = {**draw(kind, flags.steps, flags.folder), "steps": flags.steps}
        print(kind, found[kind], flush=True)
        results.write_text(json.dumps({"method": "nerfacto", "psnr": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
