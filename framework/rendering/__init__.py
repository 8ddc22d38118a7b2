"""Volume rendering and losses: from samples to colours, depths and opacities of rays and pixels."""
