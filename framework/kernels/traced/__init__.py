"""Marching, a hash grid, a network and compositing in one compiled call."""
