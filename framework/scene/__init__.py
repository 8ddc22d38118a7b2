"""Properties of a scene computed from its images, such as the space that silhouettes show to be empty."""
