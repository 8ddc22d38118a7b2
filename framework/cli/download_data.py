"""The command `ns-download-data`: public data sets by name, into folders that ns-train recognises."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from nerfloom.base.errors import FlagError
from nerfloom.base.signals import Stopped, signal_of
from nerfloom.cli.common import chosen_kind, entry_point
from nerfloom.cli.flags import read_flags
from nerfloom.downloads.catalogue import DATASETS

USAGE = """\
usage: ns-download-data NAME [--scenes SCENE ...] [--save-dir DIR] [flags]

data sets:
{table}

Scenes are put into DIR/NAME/SCENE, for example data/blender/lego. Existing scenes are not downloaded again, and an
interrupted download continues. ns-download-data NAME --help shows the flags and the scenes.
"""


@dataclass(frozen=True)
class DownloadFlags:
    """Download a public data set."""

    scenes: tuple[str, ...] = ()
    """Scenes to install. Default: all. An archive of several scenes is downloaded as a whole."""
    save_dir: Path = Path("data")
    """Folder of the data sets."""
    archive: Path | None = None
    """Zip file to use instead of downloading it."""
    keep_archives: bool = False
    """Keep the archives after unpacking, in the folder .downloads of the save-dir."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-download-data on the `arguments` of the process."""
    name, dataset, rest = chosen_kind(arguments, DATASETS, _usage(), "unknown data set")
    if any(word.partition("=")[0].replace("_", "-") == "--capture-name" for word in rest):
        raise FlagError("--capture-name is nerfstudio's; here it is --scenes")
    description = f"{dataset.title}\nscenes: {', '.join(dataset.scenes)}\nlicence: {dataset.licence}"
    flags = read_flags(DownloadFlags, f"ns-download-data {name}", rest, description=description)
    from nerfloom.downloads.install import announce, install

    announce(name, dataset, flags.save_dir, flags.scenes)
    try:
        folders = install(name, dataset, flags.save_dir, flags.scenes, flags.archive, flags.keep_archives)
    except KeyboardInterrupt as stop:
        note = "interrupted; run the same command again to continue"
        raise Stopped(signal_of(stop), note) from None
    for folder in folders:
        print(folder)
    print(f"Next: ns-train instant-ngp --data {shlex.quote(str(folders[0]))}")


def _usage() -> str:
    rows = []
    for name, dataset in DATASETS.items():
        sizes = [archive.gigabytes for archive in dataset.archives]
        known = sum(size for size in sizes if size is not None)
        size = (f"{known:g} GB" if known else "") + (" and more" if known and None in sizes else "")
        rows += [f"  {name:<18} {dataset.title}; {size or 'size unknown'}", f"  {'':<18} licence: {dataset.licence}"]
    return USAGE.format(table="\n".join(rows))


if __name__ == "__main__":
    main()
