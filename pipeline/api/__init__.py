"""What ``import infgen`` offers: simulating, reading, scoring and showing in few words.

Modules load what they need when it is used: neither importing this nor opening scenes
loads torch.
"""

from pipeline.api.scenes import Scenes, open_scenes
from pipeline.api.simulator import TrafficSimulator, load

__all__ = ["Scenes", "TrafficSimulator", "load", "open_scenes"]
