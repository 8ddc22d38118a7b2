"""Blocks of a large scene: cameras divided by place, a run for each block, and all runs in one picture."""
