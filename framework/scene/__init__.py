"""What the images show: the profile of a scene, and space that silhouettes show to be empty."""
