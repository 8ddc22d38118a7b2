"""Inputs that no reader should have to accept; a seed reproduces each of them.

The damage to a file depends on its kind: bytes are flipped under a checksum that fits again, counts and sizes are the
maxima of types, values are of other kinds, names lead elsewhere.
"""

from collections.abc import Callable, Sequence
from fnmatch import fnmatch
from random import Random

from tests.fuzz.arrays import ARCHIVE, ARRAY
from tests.fuzz.files import Files, Link
from tests.fuzz.pictures import PICTURE
from tests.fuzz.raw import RAW
from tests.fuzz.text import TEXT
from tests.fuzz.trees import damaged_json, damaged_yaml

Mutation = Callable[[Random, bytes], bytes]
TREES = {"json": damaged_json, "yml": damaged_yaml}
KINDS: dict[str, Sequence[Mutation]] = {
    "json": (*TEXT, *RAW),
    "yml": (*TEXT, *RAW),
    "txt": (*TEXT, *TEXT, *RAW),
    "tsv": (*TEXT, *TEXT, *RAW),
    "ply": (*TEXT, *RAW),
    "npy": ARRAY,
    "npz": ARCHIVE,
    "sog": ARCHIVE,
    "png": PICTURE,
    "jpg": PICTURE,
}
"""Ending of a file's name to its kinds of damage; all else is bytes."""
SHARE_OF_TREES = 0.6
"""Share of damage to names and values, in files that hold these."""
SHARE_OF_FILES = 0.08
"""Share of damage to a whole file: missing, a link, another's content."""

LARGEST = 2**25
"""Bytes of a damaged file; the worker may write twice that."""


def damaged(seed: str, files: Files, targets: Sequence[str], words: Sequence[str]) -> tuple[Files, list[str]]:
    """A folder's files with damage, and its description for each.

    Args:
        targets: patterns of the names of files that may be damaged.
        words: names of entries, to be added in the wrong place.
    """
    random, done = Random(seed), []
    files = dict(files)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        names = [name for name in sorted(files) if any(fnmatch(name, target) for target in targets)]
        if not names:
            break
        name = random.choice(names)
        content = files[name]
        if isinstance(content, Link) or random.random() < SHARE_OF_FILES:
            done.append(f"{name}: {_other_file(random, files, name)}")
        else:
            files[name], what = _other_content(random, name.rpartition(".")[2].lower(), content, words)
            done.append(f"{name}: {what}")
    return files, done


def _other_content(random: Random, ending: str, content: bytes, words: Sequence[str]) -> tuple[bytes, str]:
    if ending in TREES and random.random() < SHARE_OF_TREES:
        return TREES[ending](random, content, words)
    if ending == "ckpt":
        from tests.fuzz.checkpoints import CHECKPOINT  # brings torch

        mutation = random.choice(CHECKPOINT)
    else:
        mutation = random.choice(KINDS.get(ending, RAW))
    return mutation(random, content)[:LARGEST], mutation.__name__


def _other_file(random: Random, files: Files, name: str) -> str:
    """Change the file of a name, in place; returns a description."""
    up = "../" * (name.count("/") + 1)
    targets = {
        "itself": name.rpartition("/")[2],
        "nothing": "nowhere",
        "a folder": ".",
        "elsewhere": f"{up}outside/secret",
    }
    kind = random.choice(("missing", "another's", "a folder's", *targets))
    if kind == "missing":
        del files[name]
    elif kind == "another's":
        files[name] = files[random.choice(sorted(set(files) - {name}) or [name])]
    elif kind == "a folder's":
        files[f"{name}/inside"] = files.pop(name)
    else:
        files[name] = Link(targets[kind])
    return kind
