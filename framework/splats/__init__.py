"""The parts of a splatted method."""
