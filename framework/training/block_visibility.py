"""Training of a block's visibility network, after the block's run."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from nerfloom.base.console import track
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.blocks.block import TrainedBlock
from nerfloom.blocks.sights import Sights, queries
from nerfloom.blocks.visibility import Visibility
from nerfloom.cameras.view import View
from nerfloom.renderable import refined_cameras
from nerfloom.training.optim import Adam
from nerfloom.training.trained import load_trained

MAX_SIGHTS = 128
"""Maximum number of training images that are rendered."""
SIDE = 48
"""Minimum length of the longer side of their pictures, pixels. It is less than twice this."""
POINTS = 2**16
"""Number of points to learn from."""
STEPS, BATCH, RATE = 500, 4096, 5e-3
"""Number of steps, points of a step, and initial learning rate."""


def learn_visibility(block: TrainedBlock, device_type: Any = "auto") -> Visibility:
    """Return the visibility network of a block, trained by small pictures of its training images.

    Args:
        block: the block.
        device_type: device that renders the pictures: auto, cpu, cuda or mps. The network is on the CPU.

    Raises:
        ConfigError: if the run's settings do not fit.
        CheckpointError: if the run has no readable checkpoint.
        DataError: if the run's data cannot be read.
    """
    loaded = load_trained(block.run, None, device_type)
    model, parsed, placement = loaded.model, loaded.run.parse("train"), loaded.input_placement
    moved = refined_cameras(model, parsed.cameras.to(model.device), training=True)
    chosen = evenly_spaced(len(moved), MAX_SIGHTS)
    depths, opacities, strides = list[Tensor](), list[Tensor](), list[int]()
    for index in track(chosen.tolist(), "Looking at the block", len(chosen)):
        view = View.of(moved, index, parsed.times)
        view = replace(view, stride=max(max(view.height, view.width) // SIDE, 1))
        picture = model.render_view(view, model.background)
        depths.append(picture.median_depth.cpu())
        opacities.append(picture.accumulation.cpu())
        strides.append(view.stride)
    # The network is asked for cameras at their poses in the data, not at the block's refined poses.
    sights = Sights(parsed.cameras.to("cpu")[chosen], depths, opacities, strides)
    points, directions = queries(sights.cameras, block.radius * placement.scale, POINTS)
    labels = sights.transmittance(points, directions)
    network = Visibility(block.center, block.radius)
    return fitted(network, placement.original_points(points), placement.original_directions(directions), labels)


def fitted(network: Visibility, points: Tensor, directions: Tensor, labels: Tensor) -> Visibility:
    """Train a network on labelled points, and return it.

    Args:
        network: a new network.
        points: (N, 3) positions in the input's frame.
        directions: (N, 3) unit directions from a camera to each point, in the input's frame.
        labels: (N,) their transmittances.
    """
    inputs, random = network.inputs(points, directions), torch.Generator().manual_seed(0)
    optimizer = Adam([{"params": list(network.parameters())}], {}, RATE, (0.9, 0.99), 1e-8)
    for step in range(STEPS):
        some = torch.randint(len(inputs), (BATCH,), generator=random)
        optimizer.zero_grad()
        binary_cross_entropy_with_logits(network(inputs[some]), labels[some]).backward()
        optimizer.param_groups[0]["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * step / STEPS))
        optimizer.step()
    return network
