"""The streets of a town: topology, network, road map and surroundings."""
