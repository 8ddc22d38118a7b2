"""The loop of `plain_nerf_loop.py` with some ten lines changed: what is empty or hidden is not sampled.

Usage: python examples/plain_nerf_loop_with_skipping.py --data path/to/lego --seconds 120
"""

import argparse
import json
import math
import time
from pathlib import Path

import imageio.v3 as iio
import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, mse_loss, normalize, softplus

import nerfloom

HALF = 1.5  # of the box's edge, around the origin
STEPS = 256  # along the box's diagonal
STEP = 2 * math.sqrt(3) * HALF / STEPS
BATCH, RATE = 512, 1e-2  # rays a training step, and Adam's learning rate, which falls to a tenth


class Field(nn.Module):
    """Density and colour: features of three planes, multiplied, and two small networks."""

    def __init__(self, features: int = 16, resolution: int = 128) -> None:
        super().__init__()
        self.planes = nn.Parameter(0.1 + 0.4 * torch.rand(3, features, resolution, resolution))
        self.body = nn.Sequential(nn.Linear(features, 64), nn.ReLU(), nn.Linear(64, 16))
        self.head = nn.Sequential(nn.Linear(16 + 3, 64), nn.ReLU(), nn.Linear(64, 3), nn.Sigmoid())

    def features(self, positions: Tensor) -> Tensor:
        across = torch.stack([positions[:, [0, 1]], positions[:, [0, 2]], positions[:, [1, 2]]]) / HALF
        found = grid_sample(self.planes, across[:, None], align_corners=True)
        return self.body(found[:, :, 0].prod(0).t())

    def density(self, positions: Tensor) -> Tensor:
        return 20 * softplus(self.features(positions)[:, 0] - 3)

    def forward(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        features = self.features(positions)
        return self.head(torch.cat([features, directions], -1)), 20 * softplus(features[:, 0] - 3)


def load(data: Path, split: str) -> tuple[Tensor, Tensor, float]:
    """Images (M, H, W, 4) uint8, poses (M, 3, 4), and the focal length in pixels."""
    content = json.loads((data / f"transforms_{split}.json").read_text())
    images = torch.stack([torch.from_numpy(iio.imread(data / f"{f['file_path']}.png")) for f in content["frames"]])
    poses = torch.tensor([frame["transform_matrix"][:3] for frame in content["frames"]])
    return images, poses, 0.5 * images.shape[2] / math.tan(0.5 * content["camera_angle_x"])


def pixels(images: Tensor, poses: Tensor, focal: float, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Origins, directions and colours over white, (R, 3) each, of the pixels `index` (R,)."""
    height, width = images.shape[1:3]
    image, y, x = index // (height * width), index // width % height, index % width
    local = torch.stack([(x + 0.5 - width / 2) / focal, (height / 2 - y - 0.5) / focal, -torch.ones(len(x))], -1)
    directions = normalize((poses[image, :, :3] @ local[:, :, None])[:, :, 0], dim=-1)
    rgba = images[image, y, x] / 255
    return poses[image, :, 3], directions, rgba[:, :3] * rgba[:, 3:] + 1 - rgba[:, 3:]


def steps_in_box(origins: Tensor, directions: Tensor, jitter: bool) -> tuple[Tensor, Tensor]:
    """Distances (R, STEPS) of even steps from where rays enter the box, and which of them are in it."""
    one, other = (-HALF - origins) / directions, (HALF - origins) / directions
    enter, leave = torch.minimum(one, other).amax(-1), torch.maximum(one, other).amin(-1)
    shift = torch.rand(len(origins), 1) if jitter else 0.5
    t = enter[:, None] + (torch.arange(STEPS) + shift) * STEP
    return t, t < leave[:, None]


def render(field: Field, grid: nerfloom.OccupancyGrid, rays: nerfloom.Rays, jitter: bool) -> tuple[Tensor, int]:
    """Colours (R, 3) over white, and how many samples they were made of."""
    samples = nerfloom.sample(rays, field.density, grid, early_stop=1e-2 if jitter else 1e-4, jitter=jitter)
    return nerfloom.render(rays, samples, field, background=1.0).rgb, len(samples)


def train(data: Path, seconds: float, most_steps: int | None = None) -> list[float]:
    """The loss of each step."""
    (images, poses, focal), tested = load(data, "train"), load(data, "test")
    torch.manual_seed(0)
    field = Field()
    grid = nerfloom.OccupancyGrid([[-HALF] * 3, [HALF] * 3], num_steps=STEPS)
    optimizer = torch.optim.Adam(field.parameters(), lr=RATE)
    losses: list[float] = []
    start = time.perf_counter()
    while (share := (time.perf_counter() - start) / seconds) < 1 and len(losses) != most_steps:
        optimizer.param_groups[0]["lr"] = RATE * 0.1**share
        index = torch.randint(images[..., 0].numel(), (BATCH,))
        origins, directions, target = pixels(images, poses, focal, index)
        grid.update(len(losses), field.density)
        loss = mse_loss(render(field, grid, nerfloom.Rays(origins, directions), True)[0], target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    speed = BATCH * len(losses) / (time.perf_counter() - start)

    squares, taken, in_box = [], 0, 0
    for part in torch.arange(0, tested[0][..., 0].numel(), 211).split(4096):  # every 211th pixel of all test images
        origins, directions, target = pixels(*tested, part)
        with torch.no_grad():
            colors, count = render(field, grid, nerfloom.Rays(origins, directions), False)
        squares.append((colors - target).square())
        taken, in_box = taken + count, in_box + int(steps_in_box(origins, directions, False)[1].sum())
    psnr = -10 * math.log10(torch.cat(squares).mean().item())
    print(f"{speed:,.0f} rays/s, {len(losses):,} steps, PSNR {psnr:.2f} dB on {len(tested[0])} test images")
    print(f"samples skipped of those {in_box / len(torch.cat(squares)):.0f} a ray in the box: {1 - taken / in_box:.1%}")
    return losses


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with transforms_train.json and _test.json")
    parser.add_argument("--seconds", type=float, default=120, help="of training")
    train(**vars(parser.parse_args()))
