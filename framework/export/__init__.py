"""What a trained run leaves for other programs, in the frame and units of its input."""
