"""Properties of a scene found in its images: the profile, and space that silhouettes show to be empty."""
