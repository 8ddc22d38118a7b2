"""Operations with compiled implementations. Each file has the PyTorch reference and the compiled form of a few."""
