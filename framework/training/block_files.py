"""Loading of a scene in blocks; its runs are loaded when a picture needs them."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path
from typing import Any

from nerfloom.base.errors import DataError
from nerfloom.blocks.composed import Blocks, GaussianBlocks, Opened, few_in_memory
from nerfloom.blocks.files import BlockList, read_blocks
from nerfloom.blocks.visibility import NAME as VISIBILITY
from nerfloom.blocks.visibility import Visibility, read_visibility
from nerfloom.cameras.camera_path import read_transforms
from nerfloom.cameras.scale import read_scale
from nerfloom.data.scene import Scene
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.training.data_folder import find_data
from nerfloom.training.loaded import Loaded
from nerfloom.training.run import TRANSFORMS, Run, read_run
from nerfloom.training.trained import load_trained

MAX_NETWORKS = 256
"""Maximum number of visibility networks in memory, of 26 kB each."""


def load_blocks(file: Path, device_type: Any = "auto", data: Path | None = None, **settings: Any) -> Loaded:
    """Load a scene in blocks.

    Args:
        file: its blocks.yml; dataparser_transforms.json beside it places the scene.
        device_type: auto, cpu, cuda or mps.
        data: folder of the data, if it has moved; None for the runs' folder.
        settings: changed settings of the runs, by name; None for their own value.

    Raises:
        ConfigError: if the file or the first run cannot be read.
        CheckpointError: if the first run has no readable checkpoint. For another run, a picture that needs it raises
            this error.
        DataError: if the file or the placement is invalid, or lengths in the scene are not lengths in space (--ndc).
    """
    content, placement = read_blocks(file), read_transforms(file.parent / TRANSFORMS)

    def load(number: int) -> Opened:
        run = content.blocks[number].run
        found = load_trained(run, None, device_type, data, **settings)
        return Opened(found.model, found.input_placement)

    @lru_cache(maxsize=MAX_NETWORKS)
    def visibility(number: int) -> Visibility | None:
        network = content.blocks[number].run / VISIBILITY
        return read_visibility(network) if network.is_file() else None

    opened = few_in_memory(load)
    first = opened(0).model
    if first.scene.warped:
        raise DataError(f"{file}: its runs are in normalised device coordinates (--ndc), which blocks cannot share")
    kind = GaussianBlocks if isinstance(first, HasGaussians) else Blocks
    model = kind(content.blocks, opened, placement, _scene(first.scene, content), visibility)
    source = _source(read_run(content.blocks[0].run), file, device_type, data)
    return Loaded(model, placement, source.method, file, file, source=source).scaled(read_scale(file))


def _scene(first: Scene, content: BlockList) -> Scene:
    """Return the composed scene, given the first block's scene."""
    return dataclasses.replace(
        first,
        box=first.box.new_tensor(content.box),
        near=content.near,
        far=content.far,
        num_cameras=len({camera for block in content.blocks for camera in block.cameras}),
        camera_to_worlds=None,
    )


def _source(run: Run, file: Path, device_type: Any, data: Path | None) -> Run:
    """Return a placeholder run that holds the data of all blocks, placed as the composed scene.

    Args:
        run: the run of a block.
        file: file of the scene.
        device_type: device of the model.
        data: folder of the data; None for the run's folder.
    """
    config = dataclasses.replace(
        run.config,
        data=run.config.data if data is None else find_data(data, run.dataparser)[0],
        train_image_indices=(),
        machine=dataclasses.replace(run.config.machine, device_type=device_type),
    )
    parser = run.parser
    if hasattr(parser, "placement"):
        parser = dataclasses.replace(parser, placement=file.parent / TRANSFORMS)  # type: ignore[type-var]
    return dataclasses.replace(run, config=config, parser=parser, folder=file.parent)
