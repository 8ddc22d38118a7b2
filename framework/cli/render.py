"""The command `ns-render`: images, animations and videos of a trained run, a file of Gaussians or an octree."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfloom.base.from_nerfstudio import RENDERING
from nerfloom.cli.common import chosen_kind, entry_point, make_room, refuse_foreign, with_format, with_run
from nerfloom.cli.flags import read_flags
from nerfloom.cli.render_flags import FLAGS, USAGE
from nerfloom.cli.run_flags import OPENS
from nerfloom.evaluation.video_suffixes import check_suffix, default_video

if TYPE_CHECKING:
    from nerfloom.training.file_data import DataFormat


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-render on the `arguments` of the process."""
    import tyro

    name, path, rest = chosen_kind(arguments, FLAGS, USAGE, "unknown path")
    refuse_foreign(rest, RENDERING, "ns-render")
    words, named = with_format(f"ns-render {name}", with_run(rest, {"--rendered-output-names"}))
    options = (tyro.conf.FlagConversionOff, tyro.conf.OmitArgPrefixes)
    flags: Any = read_flags(path, f"ns-render {name}", words, OPENS, config=options)
    _render(name, flags, named)


def _render(name: str, flags: Any, named: DataFormat | None) -> None:
    output = flags.output_path or (Path("renders") if flags.shows_images else default_video(name))
    flags.check(output)
    check_suffix(output)
    found, target = flags.run.check(), flags.target(output)
    make_room(target if target.suffix else target / "render.json")
    from nerfloom.video.render import render_path

    render_path(flags.run.load(found, named), name, output, flags)


if __name__ == "__main__":
    main()
