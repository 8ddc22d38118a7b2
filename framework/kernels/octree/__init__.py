"""Light along rays through the leaves of a sparse voxel octree."""
