"""The plan of a scene in blocks: its blocks, and the training of each as a job.

FOLDER/
    plan.json                     method, flags and cameras of each block, so that a later call continues
    dataparser_transforms.json    from the input's frame to the composed scene's
    runs/000/recipe.json          method and images of block 0: their list may be too long for a command
    runs/000/placement.json       from the input's frame to that of block 0, if the format takes a placement
    runs/000/METHOD/run/          the run of block 0
    blocks.yml                    the scene in blocks
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.child import python_command
from nerfloom.base.device import num_gpus
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.json_files import read_json, read_object, write_json
from nerfloom.blocks.block import Block, TrainedBlock
from nerfloom.cameras.ndc import NdcCameras
from nerfloom.cameras.poses import Placement
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.jobs.job import Job, Resources, Step
from nerfloom.training.run import TRANSFORMS, Run
from nerfloom.training.run_path import CONFIG

PLAN = "plan.json"
"""Name of the plan in its folder."""
ALONE = ("--vis", "none", "--max-eval-images", "0")
"""Flags of a block's training. A block shows few of the held-out images, so they are evaluated in all blocks."""


@dataclass(frozen=True)
class BlockPlan:
    """Blocks to train, and how."""

    method: str
    """Name of the method."""
    flags: tuple[str, ...]
    """Flags of the method, the budget and the data, which all blocks share."""
    blocks: tuple[Block, ...]
    """The blocks."""
    placements: tuple[Placement | None, ...]
    """Placement of the input in each block's scene; None to leave it to the data format."""
    folder: Path
    """Output folder, absolute."""
    budget: str
    """Description of the budget of each block, for messages."""
    num_threads: int | None = None
    """CPU threads of each run; None for all."""
    device_type: str = "auto"
    """Device to train on."""

    def run_of(self, number: int) -> Path:
        """Return the folder of the run of block `number`."""
        return self._home(number) / self.method / "run"

    def jobs(self) -> list[Job]:
        """Return the training of each block as a job."""
        return [self._job(number) for number in range(len(self.blocks))]

    def finished(self) -> list[TrainedBlock]:
        """Return the blocks with finished training."""
        return [
            TrainedBlock(block.center, block.radius, block.cameras, self.run_of(number))
            for number, block in enumerate(self.blocks)
            if is_trained(self.run_of(number))
        ]

    def claim_folder(self, placement: Placement) -> None:
        """Write the plan and what its jobs read, with the composed scene's `placement`, so that a later call continues.

        Raises:
            ConfigError: if the folder has other blocks, or cannot be written.
            DataError: if the folder's plan cannot be read.
        """
        path, content = self.folder / PLAN, self._as_plain()
        if path.exists():
            before = read_object(path)
            if differing := [name for name in content if before.get(name) != content[name]]:
                raise ConfigError(
                    f"{self.folder} has blocks of another plan ({', '.join(differing)} differ); repeat its flags, or "
                    "choose another --output-dir"
                )
        try:
            for number, (block, own) in enumerate(zip(self.blocks, self.placements, strict=True)):
                self._home(number).mkdir(parents=True, exist_ok=True)
                recipe = {"method": self.method, "train_image_indices": list(block.cameras)}
                write_json(self._recipe(number), recipe)
                if own is not None:
                    write_json(self._home(number) / "placement.json", _plain(own))
            write_json(self.folder / TRANSFORMS, _plain(placement))
            write_json(path, content)
        except OSError as error:
            raise ConfigError(f"cannot write {self.folder}: {error.strerror or error}") from error

    def _home(self, number: int) -> Path:
        return self.folder / "runs" / f"{number:03d}"

    def _recipe(self, number: int) -> Path:
        return self._home(number) / "recipe.json"

    def _as_plain(self) -> dict[str, Any]:
        cameras = [list(block.cameras) for block in self.blocks]
        return {"method": self.method, "flags": list(self.flags), "cameras": cameras}

    def _job(self, number: int) -> Job:
        run, block = self.run_of(number), self.blocks[number]
        threads = [] if self.num_threads is None else ["--machine.num-threads", str(self.num_threads)]
        own = ["--output-dir", str(self.folder / "runs"), "--experiment-name", f"{number:03d}", "--timestamp", run.name]
        if self.placements[number] is not None:
            own += ["--placement", str(self._home(number) / "placement.json")]
        device = ["--machine.device-type", self.device_type]
        recipe = ["--load-config", str(self._recipe(number))]
        # Of two equal flags the last counts.
        command = [*python_command("nerfloom.cli.train", *recipe), *ALONE, *device, *threads, *self.flags, *own]
        resume = python_command("nerfloom.cli.train", "--resume", run)
        return Job(
            title=f"block {number:03d}",
            description=f"{len(block.cameras)} images, {self.budget}",
            steps=(Step(tuple(command), run / CONFIG, tuple(resume)),),
            log=self._home(number) / "train.log",
            finished=partial(is_trained, run),
            resources=Resources(self.num_threads, num_gpus(self.device_type)),
        )


def _plain(placement: Placement) -> dict[str, Any]:
    return {"transform": placement.transform.tolist(), "scale": placement.scale}


def is_trained(run: Path) -> bool:
    """Return whether the training of the run in folder `run` has ended by its budget."""
    try:
        summary = read_json(run / "summary.json")
    except DataError:
        return False
    return isinstance(summary, dict) and summary.get("interrupted") is False


def positions_of(parsed: ParsedScene) -> Tensor:
    """Return the positions (M, 3) float64 of the cameras of M images `parsed` in the input's frame.

    Raises:
        ConfigError: if the scene cannot be divided by the places of its cameras.
    """
    if isinstance(parsed.cameras, NdcCameras):
        raise ConfigError("normalised device coordinates (--ndc) are for one place: leave out --ndc")
    if parsed.scene_indices is not None:
        raise ConfigError("the images show several scenes; blocks divide one")
    return parsed.placement.original_points(parsed.cameras.camera_to_worlds[:, :, 3])


def block_placements(run: Run, parsed: ParsedScene, blocks: tuple[Block, ...]) -> tuple[Placement | None, ...]:
    """Return the placement of the input in each block's scene; None to leave it to the data format.

    A scene without a box is placed by its cameras: a block's cameras get the room that all cameras would have, around
    the block's centre. All blocks keep the rotation of the whole scene. A box stays where the format puts it.

    Args:
        run: a run on all images.
        parsed: its training images.
        blocks: the blocks.
    """
    if not parsed.unbounded or not hasattr(run.parser, "placement"):
        return (None,) * len(blocks)
    whole, positions = parsed.placement, positions_of(parsed)
    rotation, reach = whole.transform[:, :3], float(whole.points(positions).abs().max())
    found = []
    for block in blocks:
        center = torch.tensor(block.center, dtype=torch.float64)
        moved = Placement(torch.cat([rotation, -(rotation @ center)[:, None]], dim=-1), whole.scale)
        own = float(moved.points(positions[list(block.cameras)]).abs().max())
        found.append(dataclasses.replace(moved, scale=whole.scale * (reach / own if own > 0 else 1.0)))
    return tuple(found)
