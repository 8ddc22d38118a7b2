"""Small fully connected networks."""
