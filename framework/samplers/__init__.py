"""Samplers choose the positions on rays where a field is evaluated. Each file has one sampler."""
