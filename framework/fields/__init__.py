"""Fields, which compute density and colour at positions. Each file has one kind."""
