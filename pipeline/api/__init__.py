"""What ``import infgen`` offers: simulating, reading, scoring and showing in few words.

``infgen.NAME`` imports the module of a name when it is first used. Opening scenes so loads
no torch.
"""

MODULES = {
    "PlannerSession": "session",
    "PlayerPage": "showing",
    "Reference": "scoring",
    "SceneRollouts": "rollouts",
    "SceneScores": "scoring",
    "Scenes": "scenes",
    "TrafficSimulator": "simulator",
    "load": "simulator",
    "open_reference": "scoring",
    "open_rollouts": "rollouts",
    "open_scenes": "scenes",
    "rollouts_from_arrays": "arrays",
    "score": "arrays",
}
"""Module of each name."""
