"""Scenes of Gaussians that are larger than memory: chunks in a tree, with fewer and larger Gaussians further up."""
