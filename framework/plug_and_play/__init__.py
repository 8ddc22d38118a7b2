"""Sampling, skipping and rendering as functions, for a radiance field and a training loop of one's own."""
