"""Which photographs to compare: those next to each other, and those that look alike.

Looks are told apart by descriptors aggregated over small vocabularies of the photographs' own (VLAD: Jegou et al.
2010, "Aggregating local descriptors into a compact image representation"; normalisation: Arandjelovic and Zisserman
2013, "All about VLAD"), so that no vocabulary need be downloaded.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np

Pair = tuple[int, int]


def all_pairs(count: int) -> list[Pair]:
    """Every pair (i, j), i < j, of `count` photographs."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Each photograph with the `overlap` next ones, and with those 2, 4, 8, ... further on (`overlap` of them)."""
    offsets = set(range(1, overlap + 1)) | {2**power for power in range(overlap)}
    return sorted((i, i + offset) for offset in offsets for i in range(count - offset))


def similar_pairs(looks: np.ndarray, neighbors: int) -> list[Pair]:
    """Each photograph with the `neighbors` most similar ones: pairs (i, j), i < j, each once.

    Args:
        looks: (N, D) unit vectors; a photograph without features is 0, and in no pair.
    """
    count = len(looks)
    similarity = looks @ looks.T
    np.fill_diagonal(similarity, -np.inf)
    empty = ~looks.any(axis=1)
    similarity[:, empty] = -np.inf
    wanted = min(neighbors, count - 1)
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, :wanted]
    pairs = set()
    for i in np.flatnonzero(~empty).tolist():
        for j in nearest[i].tolist():
            if np.isfinite(similarity[i, j]):
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def looks_of(descriptors: list[np.ndarray], words: int = 32, sample: int = 400, seed: int = 0) -> np.ndarray:
    """One unit vector for each photograph, whose dot products say how alike photographs are.

    Args:
        descriptors: for each photograph (K, D) local descriptors, any number.
        words: size of the vocabulary.
        sample: at most this many descriptors of a photograph are looked at.
    Returns: (N, words D) float32; 0 for a photograph without descriptors.
    """
    random = np.random.default_rng(seed)
    chosen = [_sampled(each, sample, random) for each in descriptors]
    everything = np.concatenate(chosen) if chosen else np.zeros((0, 1), np.float32)
    if len(everything) == 0:
        return np.zeros((len(descriptors), 1), np.float32)
    centres = vocabulary(_sampled(everything, 20_000, random), words, random)
    return np.stack([aggregate(each, centres) for each in chosen])


def vocabulary(descriptors: np.ndarray, words: int, random: np.random.Generator, rounds: int = 10) -> np.ndarray:
    """(words or fewer, D) cluster centres of (K, D) descriptors, by Lloyd's algorithm."""
    centres = descriptors[random.permutation(len(descriptors))[:words]].astype(np.float32)
    for _ in range(rounds):
        nearest = _nearest(descriptors, centres)
        sums = np.zeros_like(centres)
        np.add.at(sums, nearest, descriptors)
        counts = np.bincount(nearest, minlength=len(centres))
        filled = counts > 0
        centres[filled] = sums[filled] / counts[filled, None]
    return centres


def aggregate(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """(W D,) sums of descriptors' (K, D) differences to their nearest centres (W, D); of unit length, each and all."""
    sums = np.zeros_like(centres, dtype=np.float32)
    if len(descriptors):
        nearest = _nearest(descriptors, centres)
        np.add.at(sums, nearest, descriptors - centres[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    return (sums / max(float(np.linalg.norm(sums)), 1e-12)).ravel()


def read_descriptors(database: Path, names: list[str]) -> list[np.ndarray]:
    """The local descriptors (K, 128) uint8 of photographs out of COLMAP's database; none for a name it has not."""
    with closing(sqlite3.connect(database)) as connection:
        identities = dict(connection.execute("SELECT name, image_id FROM images"))
        query = "SELECT rows, cols, data FROM descriptors WHERE image_id = ?"
        found = []
        for name in names:
            row = connection.execute(query, (identities.get(name, -1),)).fetchone()
            empty = row is None or not row[0] or row[2] is None
            found.append(
                np.zeros((0, 128), np.uint8) if empty else np.frombuffer(row[2], np.uint8).reshape(row[0], row[1])
            )
    return found


def _sampled(descriptors: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    if len(descriptors) > count:
        descriptors = descriptors[random.permutation(len(descriptors))[:count]]
    return descriptors.astype(np.float32)


def _nearest(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """(K,) index of the centre closest to each descriptor."""
    return np.argmin((centres**2).sum(1) - 2 * (descriptors @ centres.T), axis=1)
