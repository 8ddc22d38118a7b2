"""The command `ns-viewer`: a trained run, a file of Gaussians or an octree in a browser, alone or beside another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from nerfloom.base.errors import FlagError
from nerfloom.base.machine_config import ViewerConfig
from nerfloom.cli.common import entry_point, with_format, with_run
from nerfloom.cli.flags import read_flags, words_of
from nerfloom.cli.run_flags import OPENS, RunFlags
from nerfloom.training.run_path import trained_run
from nerfloom.viewer.server import check_installed


@dataclass(frozen=True, kw_only=True)
class ViewerFlags(RunFlags):
    """View a run, a file of Gaussians or an octree in a browser. New checkpoints are shown at once; Ctrl-C ends it."""

    beside: Path | None = None
    """A second run or file of the same data, shown right of a divider. The flag's name may be omitted."""
    while_moving: Path | None = None
    """A faster file of the same scene, such as its octree, drawn while the camera moves. At rest, the run is drawn. Not
    with --beside."""
    websocket_host: str = ViewerConfig.websocket_host
    """Interface to listen on; 0.0.0.0: all, so that other machines can connect. There is no password."""
    websocket_port: int = ViewerConfig.websocket_port
    """Port to listen on, or the next free one."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-viewer on the `arguments` of the process."""
    words, named = with_format("ns-viewer", with_run([_without_prefix(word) for word in arguments]))
    words = with_run(words, flag="--beside")
    flags = read_flags(ViewerFlags, "ns-viewer", words, takes=f"{OPENS} [{OPENS}]")
    if flags.beside is not None and flags.while_moving is not None:
        raise FlagError(f"--while-moving {flags.while_moving}: runs side by side have no faster file; leave one out")
    check_installed()
    other = None if flags.beside is None else replace(flags, load_config=flags.beside, load_checkpoint=None)
    found, second = flags.check(), None if other is None else other.check()
    file = None if flags.while_moving is None else trained_run(flags.while_moving, None, None)
    from nerfloom.training.load import load
    from nerfloom.viewer.commands import Commands
    from nerfloom.viewer.trained_viewer import view_loaded

    loaded = flags.load(found, named)
    # Not the folder that was named, which may hold a newer run by then.
    opens = words_of(replace(flags, load_config=loaded.origin), RunFlags)
    if named is not None:
        opens += [named[0], *words_of(named[1], type(named[1]))]
    follow = flags.load_checkpoint is None and loaded.is_run
    beside = None if other is None or second is None else other.load(second, named)
    quick = None if file is None else load(file, device_type=flags.device_type)
    view_loaded(loaded, flags.websocket_host, flags.websocket_port, Commands(opens), follow, beside, quick)


def _without_prefix(word: str) -> str:
    """Return a flag without nerfstudio's prefix: --viewer.websocket-port is --websocket-port."""
    return f"--{word.removeprefix('--viewer.')}" if word.startswith("--viewer.websocket") else word


if __name__ == "__main__":
    main()
