"""The commands of nerfloom: ns-train, ns-eval and others."""
