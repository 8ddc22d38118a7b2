"""Samplers, which choose where on each ray a field is evaluated. Each file has one sampler."""
