"""Rays, boxes, lenses and similarity transforms, as pure functions of tensors."""
