"""Settings of calibration: how the odds of coming and going are made right for rollouts."""

import math
from dataclasses import dataclass

from infgen.coerce import ConfigError, check_bounds

WAYS = ("odds", "play", "none")


@dataclass(frozen=True, slots=True)
class CalibrateSettings:
    """What rollouts add to the log-odds that agents enter and leave (SPEC 3.6).

    Attributes:
        by: ``odds`` makes the weights' held-out rates those of the logs, half second by
            half second, as their last validation found them. That does not bring right
            counts: in a rollout the network meets its own choices. ``play`` starts from
            there, plays some scenes with several biases, and takes those with which as many
            agents come, go and are there as in their logs; where nobody may come or go it
            is ``odds``.
            ``none`` adds nothing.
        split: Split whose scenes are played for it (start of the file name): never that of
            the rollouts that are scored, but as long as those, and with as much of a map.
        scenes: Scenes to play, evenly spread over those of the split, each once with every
            pair of biases; 0 for all.
        scenes_per_unit: Scenes of one unit of work.
        add_bias_range: Plays are up to this far above the odds' own bias of entering; what
            is taken may lie half as far again to either side.
        remove_bias_range: The same for leaving, above and below.
        count_radius_m: Agents nearer to the ego are counted.
    """

    by: str = "odds"
    split: str = "training"
    scenes: int = 48
    scenes_per_unit: int = 16
    add_bias_range: float = 0.8
    remove_bias_range: float = 0.3
    count_radius_m: float = 75.0

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        if self.by not in WAYS:
            ways = ", ".join(WAYS[:-1])
            raise ConfigError(f"calibrate.by is {self.by!r}; expected {ways} or {WAYS[-1]}")
        for name in ("add_bias_range", "remove_bias_range"):
            if not getattr(self, name) > 0:
                raise ConfigError(
                    f"calibrate.{name} is {getattr(self, name)}; expected more than 0 "
                    "(to leave the odds as they are, say calibrate.by=odds)"
                )
        bounds = (
            ("scenes", 0, math.inf),
            ("scenes_per_unit", 1, math.inf),
            ("count_radius_m", 0, math.inf),
        )
        check_bounds(self, "calibrate", bounds)
