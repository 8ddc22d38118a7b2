"""Rays, boxes, lenses and similarities: pure functions of tensors."""
