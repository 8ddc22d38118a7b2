"""Reasons of decisions that several methods take, for people."""

from __future__ import annotations

DEPTH_REASONS = {True: "there are depth images", False: "there are no depth images"}
"""Reason of a depth loss, by whether there are depth images."""
SPARSE_DEPTH_REASON = "the reconstruction's points are seen in {:,} pixels"
"""Reason of a depth loss, by the number of pixels in which images see sparse points."""
LIGHT_REASONS = {True: "light differs between the images", False: "the images are lit alike"}
"""Reason of an appearance of each image, by whether light, exposure or camera differ."""
POSE_REASONS = {
    "exact": "the poses are exact",
    "photographs": "the poses were found in the photographs themselves",
    "device": "the poses are those that the device tracked",
}
"""Reason of refining poses, by their source (`Scene.poses`)."""
MARCHED_REASON = "marched samples carry no gradient to rays"
"""Reason of not refining poses that are not exact."""
