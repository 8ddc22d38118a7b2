"""Adam, and gradients that wait for it."""
