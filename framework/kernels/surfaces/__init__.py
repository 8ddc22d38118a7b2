"""Signed distances of surfaces: their networks with second derivatives, and their opacities."""
