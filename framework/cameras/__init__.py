"""Cameras and their poses: from pixels to rays and back."""
