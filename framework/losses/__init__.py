"""Loss terms for a method's objective, and the functions of tensors that they use."""
