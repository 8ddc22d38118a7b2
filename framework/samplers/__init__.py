"""Samplers: where on its ray a field is evaluated. One file a way of choosing."""
