"""Pictures of a scene: its map, its agents and its signals as marks."""
