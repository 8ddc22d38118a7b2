"""The interfaces, held by plugins that exchange one part and by methods of kinds that none of ours is."""
