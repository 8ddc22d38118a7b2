"""The command `ns-edit`: Gaussians of a run or a file are cropped, cleaned, placed and written to another file."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.base.counts import counted
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cli.common import entry_point, make_room, with_format, with_run
from nerfloom.cli.flags import read_flags
from nerfloom.cli.region_flags import RegionFlags
from nerfloom.cli.run_flags import OPENS, OpenFlags

if TYPE_CHECKING:
    from nerfloom.edit.recipe import Step

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
"""Directions by name."""


@dataclass(frozen=True, kw_only=True)
class EditFlags(RegionFlags, OpenFlags):
    """Edit the Gaussians of a run or of a file, and write them to another file.

    The steps of --recipe are taken first, then --drop-floaters, then the steps of the other flags, in the order of this
    list. Positions are in the frame and unit of exports. With photographs, a line reports the cost of each step in
    held-out ones."""

    output_path: Path
    """File to write, .ply, .spz, .sog or .glb."""
    recipe: Path | None = None
    """YAML file of steps with their settings (docs/guides/recipes.md)."""
    min_opacity: float | None = None
    """Remove Gaussians of lower opacity, 0 to 1."""
    max_size: float | None = None
    """Remove Gaussians with a larger standard deviation along their longest axis, in the unit of exports."""
    drop_isolated: bool = False
    """Remove Gaussians farther from their 8 nearest neighbours than five times the median, and than five times their
    size."""
    drop_floaters: bool = False
    """Remove faint Gaussians that training images see in front of surfaces."""
    reduce_to: int | None = None
    """Number of Gaussians to keep: the ones with most weight in training images, or by opacity and area."""
    refit_steps: int = 0
    """Number of steps that make the Gaussians of --reduce-to look like all of them, for files and runs with
    photographs, such as 300; 0: none."""
    degree: int | None = None
    """Highest degree of harmonics to keep, 0 to 3."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Direction that becomes +z, as in --up=-y."""
    floor: bool = False
    """Find the floor, and make it the plane z = 0, with the origin under what the cameras look at."""
    scale: float | None = None
    """New lengths per old length, about the origin."""
    max_megabytes: float | None = None
    """Maximum file size, MB (1e6 bytes). Harmonics are reduced first, Gaussians last. Default: no limit."""
    spz_version: Literal[2, 3, 4] = 2
    """Version of spz files, as in ns-export gaussian-splat."""
    save_recipe: Path | None = None
    """YAML file to write all steps to, for --recipe."""
    max_images: int = 20
    """Maximum number of held-out images that steps are judged on, evenly spaced; 0: none."""
    time: float | None = None
    """Time of a moving scene, 0 to 1. Default: 0."""

    def steps(self) -> list[Step]:
        """Return the steps of the recipe and of the flags.

        Raises:
            FlagError: if a flag's value cannot be used.
            ConfigError: if the recipe cannot be used.
        """
        from nerfloom.edit.recipe import read_recipe, step_of

        self.regions()  # a file that holds none is refused before any work
        if self.refit_steps and self.reduce_to is None:
            raise FlagError(f"--refit-steps is {self.refit_steps}; it belongs to --reduce-to, which is not given")
        refit = {"refit_steps": self.refit_steps} if self.refit_steps else {}
        reduced = None if self.reduce_to is None else {"count": self.reduce_to, **refit}
        box, sphere = self.box(), self.sphere()
        given: list[tuple[str, str, dict[str, Any] | None]] = [
            # Floaters are in front of surfaces, which a crop may remove.
            ("drop-floaters", "drop_floaters", {} if self.drop_floaters else None),
            ("crop-box", "crop_box", None if box is None else {"low": box.low, "high": box.high}),
            ("crop-sphere", "crop_sphere", None if sphere is None else asdict(sphere)),
            ("region", "crop_region", None if self.region is None else {"file": str(self.region)}),
            ("min-opacity", "drop_faint", _only("min_opacity", self.min_opacity)),
            ("max-size", "drop_large", _only("max_size", self.max_size)),
            ("drop-isolated", "drop_isolated", {} if self.drop_isolated else None),
            ("reduce-to", "reduce_to", reduced),
            ("degree", "set_degree", _only("degree", self.degree)),
            ("up", "set_up", None if self.up is None else {"up": AXES[self.up]}),
            ("floor", "align_floor", {} if self.floor else None),
            ("scale", "scale", _only("factor", self.scale)),
        ]
        found = [] if self.recipe is None else read_recipe(self.recipe)
        try:
            return found + [step_of(name, values, f"--{flag}") for flag, name, values in given if values is not None]
        except ConfigError as error:
            raise FlagError(str(error)) from error


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-edit on the `arguments` of the process."""
    words, named = with_format("ns-edit", with_run(arguments))
    flags = read_flags(EditFlags, "ns-edit", words, takes=OPENS)
    _check(flags)
    steps, found = flags.steps(), flags.check()
    for file in (found, *(file for step in steps for file in step.files())):
        if file.resolve() == flags.output_path.resolve():
            raise ConfigError(f"--output-path {flags.output_path} is an input of this edit; name another file")
    for file in filter(None, (flags.output_path, flags.save_recipe)):
        make_room(file)
    from nerfloom.base.console import say
    from nerfloom.edit.edited import Edited
    from nerfloom.edit.held_out import HeldOut
    from nerfloom.edit.recipe import write_recipe
    from nerfloom.edit.taking import take_steps
    from nerfloom.splats.files import READ
    from nerfloom.training.load import load

    loaded = load(found, flags.load_checkpoint, flags.device_type, flags.data, data_format=named)
    edited = take_steps(Edited.of(loaded, flags.time), steps, HeldOut.of(loaded, flags.max_images))
    say(f"written: {counted(len(edited), 'Gaussians')}")
    for sentence in edited.write(flags.output_path, flags.max_megabytes, flags.spz_version):
        say(sentence)
    if flags.save_recipe is not None:
        write_recipe(flags.save_recipe, steps)
    if edited.placement is not loaded.placement and edited.has_photographs:
        say("the file is in another frame than the photographs, so that commands cannot compare it with them")
    size = flags.output_path.stat().st_size / 1e6
    say(f"{size:.2f} MB, {edited.look.words()}: {flags.output_path}")
    if flags.output_path.suffix.lower() in READ:
        name = shlex.quote(str(flags.output_path))
        say(f"next:  ns-viewer {name}  or  ns-export web {name} --output-dir exports")


def _check(flags: EditFlags) -> None:
    from nerfloom.splats.files import SUFFIXES

    if flags.output_path.suffix.lower() not in SUFFIXES:
        raise FlagError(f"--output-path is {flags.output_path}; Gaussians are written to {' or '.join(SUFFIXES)} files")
    if flags.max_megabytes is not None and not flags.max_megabytes > 0:
        raise FlagError(f"--max-megabytes must be positive, not {flags.max_megabytes}")
    if flags.max_images < 0:
        raise FlagError(f"--max-images is {flags.max_images}; it must be at least 0")


def _only(name: str, value: float | None) -> dict[str, Any] | None:
    """Return one setting by name; None if it is not given."""
    return None if value is None else {name: value}


if __name__ == "__main__":
    main()
