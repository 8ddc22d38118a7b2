"""Selection of image pairs to match: consecutive images and similar images.

Similarity is measured by local descriptors aggregated over a small vocabulary (VLAD: Jegou et al. 2010, "Aggregating
local descriptors into a compact image representation"; normalisation: Arandjelovic and Zisserman 2013, "All about
VLAD"). The vocabulary is computed from the images themselves, so nothing needs to be downloaded.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np

Pair = tuple[int, int]
"""Indices of two images."""
WORDS, SAMPLE, ROUNDS = 32, 400, 10
"""Size of the vocabulary, maximum number of descriptors used per image, and iterations that find the vocabulary."""


def all_pairs(count: int) -> list[Pair]:
    """Return every pair (i, j), i < j, of `count` images."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Return the pairs of each image with the following ones.

    Args:
        count: number of images.
        overlap: number of following images, and number of further images at distances 1, 2, 4, 8, ... beyond.
    """
    offsets = set(range(1, overlap + 1)) | {2**power for power in range(overlap)}
    return sorted((i, i + offset) for offset in offsets for i in range(count - offset))


def similar_pairs(descriptors: np.ndarray, neighbors: int, apart: int = 0) -> list[Pair]:
    """Return the pairs (i, j), i < j, of each image with the most similar ones, without repetitions.

    Args:
        descriptors: (N, D) unit vectors (`global_descriptors`); an image without features is 0 and in no pair.
        neighbors: number of similar images.
        apart: pairs with indices that differ by at most this are left out, because they are matched anyway.
    """
    count = len(descriptors)
    similarity = descriptors @ descriptors.T
    similarity[np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= apart] = -np.inf
    empty = ~descriptors.any(axis=1)
    similarity[:, empty] = -np.inf
    limit = min(neighbors, count - 1)
    nearest = np.argsort(-similarity, axis=1, kind="stable")[:, :limit]
    pairs = set()
    for i in np.flatnonzero(~empty).tolist():
        for j in nearest[i].tolist():
            if np.isfinite(similarity[i, j]):
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def global_descriptors(descriptors: list[np.ndarray]) -> np.ndarray:
    """Return a unit vector for each image; dot products measure the similarity of images.

    Args:
        descriptors: local descriptors (K, D) of each image, for any K.

    Returns:
        (N, `WORDS` D) float32; 0 for an image without descriptors.
    """
    random = np.random.default_rng(0)
    samples = [_sampled(local, SAMPLE, random) for local in descriptors]
    everything = np.concatenate(samples) if samples else np.zeros((0, 1), np.float32)
    if len(everything) == 0:
        return np.zeros((len(descriptors), 1), np.float32)
    centres = vocabulary(_sampled(everything, 20_000, random), random)
    return np.stack([aggregate(local, centres) for local in samples])


def vocabulary(descriptors: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return at most `WORDS` centres (W, D) of (K, D) `descriptors`, by Lloyd's algorithm from `random` ones."""
    centres = descriptors[random.permutation(len(descriptors))[:WORDS]].astype(np.float32)
    for _ in range(ROUNDS):
        nearest = _nearest(descriptors, centres)
        sums = np.zeros_like(centres)
        np.add.at(sums, nearest, descriptors)
        counts = np.bincount(nearest, minlength=len(centres))
        filled = counts > 0
        centres[filled] = sums[filled] / counts[filled, None]
    return centres


def aggregate(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return sums (W D,) of differences of (K, D) `descriptors` to the nearest `centres` (W, D), normalised.

    The sum of each centre has unit length, and then the whole has.
    """
    sums = np.zeros_like(centres, dtype=np.float32)
    if len(descriptors):
        nearest = _nearest(descriptors, centres)
        np.add.at(sums, nearest, descriptors - centres[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    return (sums / max(float(np.linalg.norm(sums)), 1e-12)).ravel()


def read_descriptors(database: Path, names: list[str]) -> list[np.ndarray]:
    """Return the (K, 128) uint8 descriptors of images in COLMAP's `database` by `names`; none for unknown names."""
    with closing(sqlite3.connect(database)) as connection:
        identities = dict(connection.execute("SELECT name, image_id FROM images"))
        query = "SELECT rows, cols, data FROM descriptors WHERE image_id = ?"
        descriptors = []
        for name in names:
            row = connection.execute(query, (identities.get(name, -1),)).fetchone()
            empty = row is None or not row[0] or row[2] is None
            descriptors.append(
                np.zeros((0, 128), np.uint8) if empty else np.frombuffer(row[2], np.uint8).reshape(row[0], row[1])
            )
    return descriptors


def _sampled(descriptors: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    if len(descriptors) > count:
        descriptors = descriptors[random.permutation(len(descriptors))[:count]]
    return descriptors.astype(np.float32)


def _nearest(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the index (K,) of the centre closest to each descriptor."""
    return np.argmin((centres**2).sum(1) - 2 * (descriptors @ centres.T), axis=1)
