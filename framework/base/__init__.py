"""Settings, messages, the machine and names: what everything else stands on."""
