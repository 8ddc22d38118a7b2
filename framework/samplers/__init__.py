"""Samplers choose the positions on rays at which a field is evaluated. Each file has one sampler."""
