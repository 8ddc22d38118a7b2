"""Hash grids, and planes and lines of features."""
