"""The command `ns-measure`: lengths in a run's scene, and the true length that sets its scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cli.common import entry_point, with_format, with_run
from nerfloom.cli.flags import numbers_in, read_flags
from nerfloom.cli.run_flags import OPENS, RunFlags

if TYPE_CHECKING:
    from torch import Tensor

    from nerfloom.training.loaded import Loaded


@dataclass(frozen=True, kw_only=True)
class MeasureFlags(RunFlags):
    """Measure lengths in a run's scene, and set its scale by a true length. Without flags it prints the scale."""

    between: tuple[str, str] | None = None
    """Points A B to measure between: x,y,z in the frame and unit of exports, or column,row in --image."""
    scale_points: tuple[str, str, float] | None = None
    """Points A B and their true DISTANCE, which sets the scale of the run and all its exports."""
    unit: str = "m"
    """Name of the unit of DISTANCE."""
    image: str | None = None
    """Photograph for points column,row: its file name, or the end of its path. (0, 0) is the centre of its top left
    pixel."""
    forget_scale: bool = False
    """Remove the scale, so that lengths are in the unit of the input again."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-measure on the `arguments` of the process."""
    words, named = with_format("ns-measure", with_run(arguments, ("--between", "--scale-points")))
    flags = read_flags(MeasureFlags, "ns-measure", words, takes=OPENS)
    given = [flags.between, flags.scale_points, flags.forget_scale or None]
    if sum(each is not None for each in given) > 1:
        raise FlagError("--between, --scale-points and --forget-scale exclude each other: give one at a time")
    if flags.image is not None and flags.between is None and flags.scale_points is None:
        raise FlagError("--image is the photograph of points: give --between or --scale-points with it")
    loaded = flags.load(flags.check(), named)
    if flags.between is not None:
        start, end = _points(flags, loaded, flags.between)
        say(str(loaded.measure(start, end)))
    elif flags.scale_points is not None:
        loaded = _with_scale(flags, loaded, flags.scale_points)
        loaded.keep_scale()
    elif flags.forget_scale:
        from nerfloom.cameras.scale import Scale

        loaded = loaded.scaled(Scale())
        loaded.keep_scale()
    say(loaded.scale.words())


def _with_scale(flags: MeasureFlags, loaded: Loaded, given: tuple[str, str, float]) -> Loaded:
    """Return the run in the scale of two points and their distance."""
    if loaded.scale.is_known:
        raise ConfigError(
            f"{loaded.origin} has a scale already: {loaded.scale.words()}; remove it first (--forget-scale True), "
            "since the coordinates of points change with it"
        )
    start, end = _points(flags, loaded, given[:2])
    say(f"{loaded.measure(start, end)} in the unit of the input are {given[2]:g} {flags.unit}")
    return loaded.with_scale(start, end, given[2], flags.unit)


def _points(flags: MeasureFlags, loaded: Loaded, words: tuple[str, str]) -> list[Tensor]:
    """Return two points (3,) that words describe."""
    import torch

    count, what = 2, "two numbers column,row of --image"
    if flags.image is None:
        count, what = 3, "three numbers x,y,z (or column,row, with --image)"
    numbers = [numbers_in(word, count, "a point", what) for word in words]
    if flags.image is None:
        return [torch.tensor(each, dtype=torch.float64) for each in numbers]
    view = loaded.photograph(flags.image)
    found = [loaded.pick(view, column, row) for column, row in numbers]
    for word, point in zip(words, found, strict=True):
        say(f"{word} of {flags.image}: {','.join(f'{value:.6g}' for value in point.tolist())}")
    return found


if __name__ == "__main__":
    main()
