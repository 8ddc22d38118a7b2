"""People and things that are in one photograph only: distractors for methods that learn what all images share.

The same few people are in many images, each time elsewhere. They are placed one after another, in view of the image's
camera, until they cover the wanted share of it.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from nerfloom.dataparsers.procedural.courtyard import COURTYARD, GROUND, WALL
from nerfloom.dataparsers.procedural.scene import Colour, Part, Parts, blend, checks, mix, smoothstep, wave
from nerfloom.dataparsers.procedural.shapes import Box, Cylinder, Sphere, Union
from nerfloom.dataparsers.procedural.views import visible_parts

NUM_PEOPLE, NUM_THINGS = 8, 4
"""Number of people and of things that appear in the images of a data set."""
PROBE = (64, 64)
"""Size of the images that measure coverage while placing, pixels."""
_TRIES = 300  # attempts to place one more in an image
_SLACK = 0.015  # largest difference of an image's coverage from the wanted one; the next images make up for it
_NEAREST, _FURTHEST = 0.9, 6.0  # distance from the camera
_PLINTH, _STEP = 1.15, 0.16  # radius and height of the plinth; people stand on it too
_SKIN, _HAIR = (0.62, 0.40, 0.28), (0.06, 0.045, 0.035)


def _person(height: float, stride: float) -> Union:
    """Return a figure that stands at height 0."""
    h = height
    return Union(
        (
            (Cylinder(0.058 * h, 0.23 * h), (0.065 * h, stride * h, 0.23 * h)),
            (Cylinder(0.058 * h, 0.23 * h), (-0.065 * h, -stride * h, 0.23 * h)),
            (Cylinder(0.135 * h, 0.18 * h), (0.0, 0.0, 0.62 * h)),
            (Cylinder(0.04 * h, 0.17 * h), (0.175 * h, -stride * h, 0.60 * h)),
            (Cylinder(0.04 * h, 0.17 * h), (-0.175 * h, stride * h, 0.60 * h)),
            (Sphere(0.095 * h), (0.0, 0.0, 0.895 * h)),
        )
    )


def _clothes(height: float, shirt: Colour, stripe: Colour, trousers: Colour, p: Tensor) -> Tensor:
    """Return hair, skin, a striped shirt and trousers (3, R) at points `p` (3, R)."""
    z = p[2] / height
    worn = mix(
        p.new_tensor(trousers)[:, None],
        blend(shirt, stripe, 0.5 + 0.5 * wave(z * 110.0, 3.0)),
        smoothstep(0.44, 0.46, z),
    )
    head = blend(_SKIN, _HAIR, smoothstep(0.91, 0.93, z + 0.25 * p[1] / height))
    return mix(worn, head, smoothstep(0.79, 0.81, z))


def _bright(random: np.random.Generator) -> Colour:
    return colorsys.hsv_to_rgb(random.uniform(), random.uniform(0.4, 1.0), random.uniform(0.25, 0.95))


def cast(seed: int) -> list[Part]:
    """Return the people and things of the data set of a `seed`, standing at the origin at height 0."""
    random = np.random.default_rng([seed, 1])
    found = []
    for _ in range(NUM_PEOPLE):
        height = random.uniform(1.0, 1.35)
        texture = partial(_clothes, height, _bright(random), _bright(random), _bright(random))
        found.append(Part(_person(height, random.uniform(0.02, 0.09)), (0.0, 0.0, 0.0), 0.0, texture, 0.0))
    for index in range(NUM_THINGS):
        size, texture = random.uniform(0.12, 0.24), partial(checks, _bright(random), _bright(random), 25.0)
        shape = Box((size, 0.8 * size, 1.2 * size)) if index % 2 else Sphere(size)
        raised = Union(((shape, (0.0, 0.0, 1.2 * size if index % 2 else size)),))
        found.append(Part(raised, (0.0, 0.0, 0.0), 0.0, texture, 0.0))
    return found


def crowds(poses: Sequence[npt.NDArray[np.float64]], share: float, seed: int) -> list[Parts]:
    """Return the people and things of each image, which cover a share of the pixels on average.

    Images differ: their shares are evenly spread from half to one and a half times the mean.

    Args:
        poses: camera-to-world matrices (4, 4).
        share: mean share of pixels that show a distractor at their centre, at most 0.4.
        seed: seed of the data set. The same seed gives the same distractors.
    """
    random = np.random.default_rng([seed, 2])
    wanted = share * random.permutation(np.linspace(0.5, 1.5, len(poses)))
    figures, found, owed = cast(seed), [], 0.0
    for pose, of_image in zip(poses, wanted, strict=True):
        placed, covered = _fill(pose, figures, max(of_image + owed, 0.0), random)
        owed += of_image - covered
        found.append(placed)
    return found


def _fill(
    pose: npt.NDArray[np.float64], figures: Sequence[Part], wanted: float, random: np.random.Generator
) -> tuple[Parts, float]:
    """Return distractors that cover about the share `wanted` of the image of a camera, and the share they cover."""
    depth, _ = visible_parts(pose, PROBE, COURTYARD)
    hidden = np.zeros(PROBE[::-1], dtype=bool)
    placed: dict[str, Part] = {}
    for _ in range(_TRIES):
        if hidden.mean() >= wanted - _SLACK:
            break
        figure = figures[int(random.integers(len(figures)))]
        spot = _spot(pose, figure, list(placed.values()), random)
        if spot is None:
            continue
        own, _ = visible_parts(pose, PROBE, {"": spot})
        more = hidden | (own < depth)
        if hidden.mean() < more.mean() <= wanted + _SLACK:
            placed[f"distractor {len(placed)}"], hidden = spot, more
    return placed, float(hidden.mean())


def _spot(
    pose: npt.NDArray[np.float64], figure: Part, others: Sequence[Part], random: np.random.Generator
) -> Part | None:
    """Return the figure at a random place in front of a camera; None if something stands there."""
    ahead, right, eye = -pose[:2, 2] / np.linalg.norm(pose[:2, 2]), pose[:2, 0], pose[:2, 3]
    distance = random.uniform(_NEAREST, _FURTHEST)
    x, y = (eye + distance * (ahead + random.uniform(-0.38, 0.38) * right)).tolist()
    yaw, radius = random.uniform(0.0, 2 * math.pi), math.hypot(x, y)
    z = GROUND + (_STEP if radius < _PLINTH else 0.0)
    if max(abs(x), abs(y)) > WALL - 0.3 or abs(radius - _PLINTH) < 0.2:
        return None
    if any(math.dist((x, y), other.centre[:2]) < 0.4 for other in others):
        return None
    heights = torch.linspace(0.25, 1.2, 6, dtype=torch.float64)
    axis = torch.stack([torch.full_like(heights, x), torch.full_like(heights, y), z + heights])
    for part in COURTYARD.values():  # their yaw turns about their own axis, which the bound of the shape allows for
        if (
            part.shape.bound < 1.0
            and float((axis - axis.new_tensor(part.centre)[:, None]).norm(dim=0).min()) < part.shape.bound + 0.2
        ):
            return None
    return figure._replace(centre=(x, y, z), yaw=yaw)
