"""Tracks of a reconstruction: which images see its sparse points, and how well their distances are known."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

FEWEST = 2
"""Minimum number of images that see a point, of those that may be learned from; one image knows no distance."""
LARGEST_DEVIATION = 0.1
"""Maximum standard deviation of a distance that is used, as a fraction of the distance."""


@dataclass(frozen=True)
class Sightings:
    """O sparse points as M images see them, with repetitions: a point that three images see is here three times."""

    images: Tensor
    """(O,) int64 image of each sighting."""
    points: Tensor
    """(O, 3) position of the point, scene units."""
    deviations: Tensor
    """(O,) standard deviation of its distance from the image's camera, scene units."""

    def __len__(self) -> int:
        return len(self.images)

    def of_images(self, chosen: Tensor) -> Sightings:
        """Return the sightings of some images, which are numbered anew.

        Args:
            chosen: (S,) int64 the images, without repetitions.
        """
        kept, images = _renumbered(self.images, chosen)
        return Sightings(images, self.points[kept], self.deviations[kept])


@dataclass(frozen=True)
class Tracks:
    """K sparse points, and O sightings of them in M images."""

    points: Tensor
    """(K, 3) positions."""
    images: Tensor
    """(O,) int64 image of each sighting."""
    seen: Tensor
    """(O,) int64 point of each sighting."""
    angles: Tensor
    """(O,) standard deviation of each sighting's direction, radians: the reprojection error over the focal length."""

    def of_images(self, chosen: Tensor) -> Tracks:
        """Return all points, and the sightings in some images, which are numbered anew.

        Args:
            chosen: (S,) int64 the images, without repetitions.
        """
        kept, images = _renumbered(self.images, chosen)
        return Tracks(self.points, images, self.seen[kept], self.angles[kept])

    def without(self, images: Tensor) -> Tracks:
        """Return all points, without the sightings in some images.

        Args:
            images: (M,) bool, the images to leave out.
        """
        kept = ~images[self.images]
        return Tracks(self.points, self.images[kept], self.seen[kept], self.angles[kept])

    def at(self, points: Tensor) -> Tracks:
        """Return the same sightings of points that were moved.

        Args:
            points: (K, 3) the new positions. Those that are not finite are left out, and the others numbered anew.
        """
        finite = points.isfinite().all(-1)
        kept = finite[self.seen]
        seen = (finite.cumsum(0) - 1)[self.seen[kept]]
        return Tracks(points[finite], self.images[kept], seen, self.angles[kept])

    def confirmed(self) -> Tensor:
        """Return whether at least `FEWEST` of the images see a point, (K,) bool."""
        return torch.bincount(self.seen, minlength=len(self.points)) >= FEWEST

    def sightings(self, centers: Tensor) -> Sightings:
        """Return the sightings of confirmed points whose distance is known well enough.

        Args:
            centers: (M, 3) positions of the cameras.
        """
        deviations = distance_deviations(self, centers)
        distances = (self.points[self.seen] - centers[self.images].to(self.points)).norm(dim=-1)
        known = self.confirmed()[self.seen] & (deviations <= LARGEST_DEVIATION * distances)
        return Sightings(self.images[known], self.points[self.seen[known]].float(), deviations[known].float())


def distance_deviations(tracks: Tracks, centers: Tensor) -> Tensor:
    """Return the standard deviation (O,) float64 of the distance at which each sighting's camera sees its point.

    A sighting in the unit direction d from the distance r, with an angular error of a, holds the point across its ray
    and not along it: its information is (1 - d d^T) / (r a)^2. The inverse of the sum over the track is the covariance
    of the point (Hartley and Zisserman 2004, section 5.2), and its part along a ray the variance of the distance. So
    what counts is the reprojection error, the number of images, and the angle between their rays. That a point is
    somewhere at about its distance is taken for granted, which keeps a single sighting's covariance finite.

    Args:
        tracks: K points and O sightings.
        centers: (M, 3) positions of the cameras.
    """
    apart = tracks.points[tracks.seen].double() - centers.double()[tracks.images]
    squared = apart.square().sum(-1).clamp(min=1e-24)
    outer = apart[:, :, None] * apart[:, None, :] / squared[:, None, None]
    eye = torch.eye(3, dtype=torch.float64, device=apart.device)
    spread = squared * tracks.angles.double().square().clamp(min=1e-24)
    across = (eye - outer) / spread[:, None, None] + outer / squared[:, None, None]
    information = across.new_zeros(len(tracks.points), 3, 3).index_add_(0, tracks.seen, across)
    unseen = torch.bincount(tracks.seen, minlength=len(tracks.points)) == 0
    covariance = torch.linalg.inv(torch.where(unseen[:, None, None], eye, information))
    return ((covariance[tracks.seen] * outer).sum((-1, -2))).clamp(min=0).sqrt()


def _renumbered(images: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Return which sightings are in `chosen` images, and the place of their images among these."""
    most = int(max(images.max() if len(images) else -1, chosen.max() if len(chosen) else -1)) + 1
    places = torch.full((most,), -1, dtype=torch.int64, device=images.device)
    places[chosen] = torch.arange(len(chosen), device=images.device)
    found = places[images]
    return found >= 0, found[found >= 0]
