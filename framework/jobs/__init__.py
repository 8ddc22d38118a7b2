"""Jobs: commands that run for long, and the launchers that run them on this machine or on a cluster."""
