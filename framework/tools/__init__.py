"""Tools around training: processing, comparison, benchmarks, stress, checks, integrations."""
