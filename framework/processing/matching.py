"""Choice of image pairs to match, and matching of pairs that are not in COLMAP's database yet."""

from __future__ import annotations

from nerfloom.base.console import say
from nerfloom.processing import colmap, database, retrieval
from nerfloom.processing.reconstruction import Reconstruction

ADJACENT = 3
"""Number of following images that retrieval matches with each image, besides similar ones."""
LOOPS = 5
"""Number of similar images beyond the following ones that sequential matching adds for each image, to close loops."""
RULES = {
    "exhaustive": "all",
    "sequential": "each image with the next ones and with similar ones, to close loops",
    "retrieval": "each image with similar ones",
}
"""Description of each rule."""


def choose_matching(method: str, count: int, exhaustive_limit: int, ordered: bool) -> str:
    """Return the matching rule: exhaustive, sequential or retrieval.

    Args:
        method: the user's choice, possibly auto.
        count: number of images.
        exhaustive_limit: maximum number of images for auto to match all pairs.
        ordered: whether the images were taken one after the other, in the order of their names.
    """
    if method != "auto":
        return method
    if ordered:
        return "sequential"
    return "exhaustive" if count <= exhaustive_limit else "retrieval"


def choose_pairs(matching: str, names: list[str], state: Reconstruction) -> list[tuple[str, str]]:
    """Return the pairs of `names` to match by the rule `matching`, by the features of `state` where it needs them."""
    count, flags = len(names), state.flags
    if matching == "exhaustive":
        chosen = retrieval.all_pairs(count)
    else:
        descriptors = retrieval.global_descriptors(retrieval.read_descriptors(state.database, names))
        if matching == "sequential":
            near = retrieval.sequential_pairs(count, flags.sequential_overlap)
            alike = retrieval.similar_pairs(descriptors, LOOPS, apart=flags.sequential_overlap)
        else:
            near = retrieval.sequential_pairs(count, ADJACENT)
            alike = retrieval.similar_pairs(descriptors, flags.num_neighbors)
        chosen = sorted({*near, *alike})
    return [(names[i], names[j]) for i, j in chosen]


def pairs_of(left: list[str], names: list[str], state: Reconstruction) -> list[tuple[str, str]]:
    """Return more pairs for the images `left` of `state`: with all `names`, or with similar ones of many images."""
    chosen = set(left)
    if len(names) <= state.flags.exhaustive_limit:
        every = retrieval.all_pairs(len(names))
    else:
        descriptors = retrieval.global_descriptors(retrieval.read_descriptors(state.database, names))
        every = retrieval.similar_pairs(descriptors, state.flags.num_neighbors)
    return [(names[i], names[j]) for i, j in every if names[i] in chosen or names[j] in chosen]


def match(state: Reconstruction, pairs: list[tuple[str, str]], count: int, rule: str) -> None:
    """Match `pairs` of names of `count` images in `state` that are not in the database; `rule` describes them."""
    known = database.pairs(state.database)
    missing = [pair for pair in pairs if pair not in known]
    kept = f", {len(pairs) - len(missing)} of them reused" if len(missing) < len(pairs) else ""
    say(f"matching: {len(pairs):,} of {count * (count - 1) // 2:,} pairs{kept}: {rule}")
    before = state.seconds.get("matching", 0.0)
    with state.timed("matching"):
        if missing:
            everything = len(missing) == count * (count - 1) // 2
            arguments = (state.database, missing, state.database.with_name("pairs.txt"), everything, state.flags)
            state.run(colmap.match_pairs, arguments, "Matching", len(missing), unit="pairs")
    done, connected = database.rows(state.database, "two_view_geometries"), database.connected(state.database)
    say(f"matching: {connected:,} of {done:,} pairs are connected, in {state.seconds['matching'] - before:.1f} s")
