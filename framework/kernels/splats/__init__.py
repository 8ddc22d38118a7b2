"""Gaussians on images: projection, tiles and blending."""
