"""The command `ns-viewer`: a trained run, or one in training, in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nerfloom.base.errors import ConfigError
from nerfloom.base.extras import install_command
from nerfloom.base.machine_config import ViewerConfig
from nerfloom.cli.common import run_command, with_format, with_run
from nerfloom.cli.flags import read_flags
from nerfloom.training.run_path import trained_run


@dataclass(frozen=True)
class ViewerFlags:
    """Look at a trained run in a browser. It shows newer checkpoints as they are written; Ctrl-C ends it."""

    load_config: Path
    """RUN_FOLDER, its config.yml, a folder above (its newest run), or a file of Gaussians (.ply, .spz, .splat); the
    flag's name may be left out."""
    load_checkpoint: Path | None = None
    """Checkpoint to load; if not given, the newest, and each that is written later."""
    data: Path | None = None
    """Folder of the data, if it has moved since training; needed with a file of Gaussians."""
    websocket_host: str = ViewerConfig.websocket_host
    """Interface to listen on; 0.0.0.0 for all, from which other machines can connect. There is no password."""
    websocket_port: int = ViewerConfig.websocket_port
    """Port to listen on; the next free one if it is taken."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""


def main() -> None:
    """Run ns-viewer on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    words, named = with_format("ns-viewer", with_run([_without_prefix(word) for word in arguments]))
    flags = read_flags(ViewerFlags, "ns-viewer", words, takes="RUN_FOLDER")
    if (command := install_command("viewer")) is not None:
        raise ConfigError(f"the viewer needs viser: {command}")
    found = trained_run(flags.load_config, flags.load_checkpoint, flags.data)
    from nerfloom.splats.files import is_splat_file
    from nerfloom.training.splat_files import load_run_or_splats
    from nerfloom.viewer.trained_viewer import view_trained

    trained = load_run_or_splats(found, flags.load_checkpoint, flags.device_type, flags.data, data_format=named)
    follow = flags.load_checkpoint is None and not is_splat_file(found)
    view_trained(trained, flags.websocket_host, flags.websocket_port, follow)


def _without_prefix(word: str) -> str:
    """Return a flag without nerfstudio's prefix: --viewer.websocket-port is --websocket-port."""
    return f"--{word.removeprefix('--viewer.')}" if word.startswith("--viewer.websocket") else word


if __name__ == "__main__":
    main()
