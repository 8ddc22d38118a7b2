"""Measurements of the machine that `ns-bench` makes: kernels, training steps, pictures and methods."""
