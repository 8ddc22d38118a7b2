"""What is done around training: processing, comparing, measuring, testing."""
