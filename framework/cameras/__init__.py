"""Cameras and their poses: rays of pixels, and projections of points."""
