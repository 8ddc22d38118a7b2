"""The command `ns-blocks`: a large scene in blocks, each an ordinary run, which together stand for a run."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nerfloom.base.counts import counted
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cli.common import entry_point
from nerfloom.cli.flags import read_flags
from nerfloom.cli.job_flags import JobFlags
from nerfloom.training.run_path import check_data, check_writable, data_name

if TYPE_CHECKING:
    from nerfloom.blocks.block import Block, TrainedBlock
    from nerfloom.data.parsed_scene import ParsedScene
    from nerfloom.training.block_plan import BlockPlan
    from nerfloom.training.run import Run

MAX_OVERLAP = 0.9
NAMED = 5
"""Maximum number of images that a message names."""


@dataclass(frozen=True)
class BlocksFlags(JobFlags):
    """Train a large scene in blocks: cameras are divided by place, and each block is a run of its own.

    Writes blocks.yml, which ns-eval, ns-render, ns-viewer and ns-export open like a run. If run again, it continues
    where it was stopped."""

    method: str = "nerfacto"
    """Method, with its flags in quotes: "zip-nerf --num-levels 8"."""
    max_seconds: float | None = None
    """Seconds of training of each block."""
    max_num_iterations: int | None = None
    """Training steps of each block."""
    max_cameras: int = 300
    """Maximum number of images of a block, overlap included. Blocks that have more are cut in two."""
    block_size: float | None = None
    """Edge of the cubes of a grid, in units of the input, instead of --max-cameras."""
    overlap: float = 0.5
    """Share of a block's extent that it has in common with the next one, 0 to 0.9."""
    min_cameras: int = 8
    """Minimum number of images of a block, overlap included. Blocks that have fewer are left out."""
    match_colors: bool = True
    """Match the colours of neighbours by pictures of the images that they share."""
    only_split: bool = False
    """Only print the blocks."""
    output_dir: Path | None = None
    """Folder of the runs and of blocks.yml. Default: outputs/blocks-DATA."""

    def check(self) -> None:
        """Check the values of the flags.

        Raises:
            FlagError: if one is out of range.
        """
        if self.min_cameras < 1 or self.max_cameras < self.min_cameras:
            raise FlagError(
                f"--min-cameras is {self.min_cameras} and --max-cameras {self.max_cameras}; both must be at least 1, "
                "and the second not below the first"
            )
        if self.block_size is not None and not 0 < self.block_size < math.inf:
            raise FlagError(f"--block-size is {self.block_size:g}; it must be above zero and finite")
        if not 0 <= self.overlap <= MAX_OVERLAP:
            raise FlagError(f"--overlap is {self.overlap:g}; it must be from 0 to {MAX_OVERLAP}")

    def budget(self) -> list[str]:
        """Return the flags of ns-train for the budget."""
        flags: list[str] = []
        for name in ("max_seconds", "max_num_iterations"):
            if (value := getattr(self, name)) is not None:
                flags += ["--" + name.replace("_", "-"), str(value)]
        return flags


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-blocks on the `arguments` of the process."""
    flags = read_flags(BlocksFlags, "ns-blocks", arguments)
    flags.check()
    if flags.data is not None:
        check_data(flags.data)
    name = data_name(flags.data)
    folder = (flags.output_dir or Path("outputs") / f"blocks-{name}").absolute()
    check_writable(folder, "the runs to")
    from nerfloom.cli.train import run_of
    from nerfloom.comparison.plan import split_method, split_words

    method, own = split_method(flags.method, "--method")
    shared = [*own, *flags.budget()]
    if flags.data is not None:
        shared += ["--data", str(flags.data.absolute())]
    shared += split_words(flags.data_flags, "--data-flags")
    build(flags, run_of(method, shared), tuple(shared), folder)


def build(flags: BlocksFlags, run: Run, shared: tuple[str, ...], folder: Path) -> None:
    """Divide the cameras, train the blocks that are not finished, and write blocks.yml.

    Args:
        flags: flags of the command.
        run: the run that ns-train would start on all images.
        shared: flags of ns-train that all blocks share.
        folder: output folder, absolute.

    Raises:
        ConfigError: if blocks fail, or their training images are chosen already.
        DataError: if the data cannot be read.
        Stopped: on a signal, after running blocks have saved.
    """
    from nerfloom.base.console import say
    from nerfloom.training.block_plan import BlockPlan, block_placements

    if run.config.train_image_indices or run.config.max_train_images is not None:
        raise FlagError("blocks choose the training images: leave out --train-image-indices and --max-train-images")
    parsed = run.parser.parse(run.config.data, "train")
    blocks = split(flags, parsed)
    if flags.only_split:
        return
    plan = BlockPlan(
        run.method,
        shared,
        blocks,
        block_placements(run, parsed, blocks),
        folder,
        _described(flags),
        flags.num_threads,
        flags.device_type,
    )
    plan.claim_folder(parsed.placement)
    failures = flags.chosen_launcher(folder).run(plan.jobs())
    if finished := plan.finished():
        file = _compose(flags, plan, parsed, finished)
        say(f"{len(finished)} of {len(blocks)} blocks: {file}")
        say(f"next:  ns-eval {shlex.quote(str(file))}  or  ns-viewer {shlex.quote(str(file))}")
    if failures:
        raise ConfigError(f"{len(failures)} of {len(blocks)} blocks failed; run the same command again to continue")


def split(flags: BlocksFlags, parsed: ParsedScene) -> tuple[Block, ...]:
    """Divide the cameras of the training images `parsed` into blocks by `flags`, and print them.

    Raises:
        ConfigError: if there is no block, or the scene cannot be divided.
    """
    from nerfloom.base.console import say
    from nerfloom.blocks.split import grid_blocks, in_no_block, tree_blocks
    from nerfloom.training.block_plan import positions_of

    positions, least = positions_of(parsed), flags.min_cameras
    if flags.block_size is None:
        blocks = tree_blocks(positions, flags.max_cameras, flags.overlap, least)
    else:
        blocks = grid_blocks(positions, flags.block_size, flags.overlap, least)
    for number, block in enumerate(blocks):
        place = ", ".join(f"{value:.6g}" for value in block.center)
        say(f"block {number:03d}: {counted(len(block.cameras), 'images')} around ({place}), radius {block.radius:.4g}")
    if left := in_no_block(blocks, len(positions)):
        names = ", ".join(parsed.image_paths[index].name for index in left[:NAMED])
        more = ", ..." if len(left) > NAMED else ""
        say(f"{len(left)} of {len(positions)} images are in no block (--min-cameras {least}): {names}{more}")
    if not blocks:
        raise ConfigError(f"no block has {least} images; use a smaller --min-cameras, or larger blocks")
    return tuple(blocks)


def _described(flags: BlocksFlags) -> str:
    """Return a description of the budget of a block."""
    seconds = None if flags.max_seconds is None else f"{flags.max_seconds:g} s of training"
    steps = None if flags.max_num_iterations is None else f"{flags.max_num_iterations} steps"
    return ", ".join(filter(None, (seconds, steps))) or "the method's budget"


def _compose(flags: BlocksFlags, plan: BlockPlan, parsed: ParsedScene, finished: list[TrainedBlock]) -> Path:
    """Write blocks.yml, with matched colours, and missing visibility networks; return its path."""
    from nerfloom.base.console import say
    from nerfloom.blocks.composed import Blocks
    from nerfloom.blocks.files import NAME, BlockList, write_blocks
    from nerfloom.blocks.matching import matched
    from nerfloom.training.block_files import load_blocks

    low, high = ((float(x), float(y), float(z)) for x, y, z in parsed.box.tolist())
    content, file = BlockList((low, high), parsed.near, parsed.far, tuple(finished)), plan.folder / NAME
    write_blocks(file, content)
    if len(finished) > 1:
        _add_visibility(flags, finished)
    if flags.match_colors and len(finished) > 1:
        say("matching the colours of the blocks (--match-colors)")
        model = load_blocks(file, flags.device_type).model
        assert isinstance(model, Blocks)
        times = None if parsed.times is None else parsed.times.to(model.device)
        blocks = matched(model, parsed.cameras.to(model.device), times)
        write_blocks(file, replace(content, blocks=tuple(blocks)))
    return file


def _add_visibility(flags: BlocksFlags, finished: list[TrainedBlock]) -> None:
    """Train the visibility networks of blocks that have none."""
    from nerfloom.base.console import say
    from nerfloom.blocks.visibility import NAME, write_visibility
    from nerfloom.training.block_visibility import learn_visibility

    missing = [block for block in finished if not (block.run / NAME).exists()]
    for number, block in enumerate(missing, 1):
        say(f"visibility network {number} of {len(missing)}: {block.run}")
        write_visibility(block.run / NAME, learn_visibility(block, flags.device_type))


if __name__ == "__main__":
    main()
