"""Marching of rays through an occupancy grid."""
