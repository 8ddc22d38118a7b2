"""Training of any method by one trainer."""
