"""Fields: what the scene is at a point. One file a family."""
