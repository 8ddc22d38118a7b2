"""From samples to what is seen: volume rendering, and losses."""
