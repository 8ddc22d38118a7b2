"""Choice of a captured scene's sparse points, and their uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.data.tracks import DOUBTS, MAX_DEVIATION, Observations, Sightings, Tracks
from nerfloom.dataparsers.posed_images import PosedImages


@dataclass(frozen=True)
class SparsePoints:
    """Sparse points in the scene's frame."""

    points: Tensor | None
    """(K, 3) all usable points; None if there are none."""
    sound: Tensor | None
    """(S, 3) the points with trusted distances, or all points if there are none; None without points."""
    sightings: Sightings | None
    """Which images see which points at a known distance; None without tracks."""
    observations: Observations | None = None
    """Which of the M images see which of `points`; None without tracks of these points."""


def sparse_points(images: PosedImages, placement: Placement, cameras: Cameras, known: Tensor | None) -> SparsePoints:
    """Return the sparse points in the scene's frame, and report their number for each use.

    A point too inaccurate for distances still shows roughly where a surface is. Left out are points beyond the range of
    float32, and points seen in held-out images and in fewer than two others, since only held-out images know them. (The
    positions of the remaining points, like the poses, come from all images.)

    Args:
        images: M images.
        placement: placement of the scene.
        cameras: M cameras in the scene's frame.
        known: the training images, if a method may learn from these alone; None for all images, without a report.
    """
    points, sound, sightings, observations, notes = None, None, None, None, []
    if images.tracks is not None and len(images.tracks.points):
        every = images.tracks.at(placement.points(images.tracks.points).float())
        held_out = torch.zeros(len(cameras), dtype=torch.bool) if known is None else _others(known, len(cameras))
        chosen, tracks = every.known_without(held_out), every.without(held_out)
        centers = cameras.camera_to_worlds[:, :, 3]
        sightings = tracks.sightings(centers) if bool(tracks.confirmed().any()) else None
        points, sound = every.points[chosen], every.points[chosen & (every.doubts == 0)]
        observations = Observations(tracks.images, tracks.seen).of_points(chosen)
        lost = {"out of range": len(images.tracks.points) - len(every.points)}
        lost["known to held-out images alone"] = int((~chosen).sum())
        notes = [
            _note(len(points), len(images.tracks.points), "are used", lost),
            _on_distances(tracks, centers, chosen),
        ]
    if images.points is not None:
        points = placement.points(images.points.double()).float()
        points = sound = points[points.isfinite().all(-1)]
        observations = None  # observations refer to the tracks' points
        lost = {"out of range": len(images.points) - len(points)}
        notes = [_note(len(points), len(images.points), "of a file are used", lost), *notes[1:]]
    if known is not None and notes:
        say(f"sparse points: {', '.join(notes)}")
    if points is None or not len(points):
        return SparsePoints(None, None, sightings)
    return SparsePoints(points, points if sound is None or not len(sound) else sound, sightings, observations)


def _others(known: Tensor, count: int) -> Tensor:
    """Return which of `count` images are not `known`, (count,) bool."""
    others = torch.ones(count, dtype=torch.bool)
    others[known] = False
    return others


def _on_distances(tracks: Tracks, centers: Tensor, chosen: Tensor) -> str:
    """Return a report on the `chosen` points (K,): how many have known distances, and why others have none."""
    distant = torch.zeros(len(tracks.points), dtype=torch.bool)
    distant[tracks.seen[tracks.known_distances(centers)]] = True
    doubts = tracks.doubts[chosen & ~distant]
    lacking = {doubt: int((doubts == number).sum()) for number, doubt in enumerate(DOUBTS) if number}
    lacking[f"uncertain by more than {MAX_DEVIATION:.0%}"] = int((doubts == 0).sum())
    return _note(int(distant.sum()), None, "at known distances", lacking)


def _note(count: int, total: int | None, what: str, lost: Mapping[str, int]) -> str:
    """Return how many points serve a purpose, and how many do not for each reason."""
    reasons = ", ".join(f"{number:,} {reason}" for reason, number in lost.items() if number)
    counted = f"{count:,}" if total is None else f"{count:,} of {total:,}"
    return f"{counted} {what}" + (f" (not {reasons})" if reasons else "")
