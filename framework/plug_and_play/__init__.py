"""Sampling, skipping and rendering as functions, for a user's own radiance field and training loop."""
