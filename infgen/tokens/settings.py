"""Settings of the stage ``tokenize``."""

import math
from dataclasses import dataclass

from infgen.coerce import ConfigError, check_numbers


@dataclass(frozen=True, slots=True)
class TokenSettings:
    """How scenes become tokens (SPEC 1.2, 1.6, 3).

    Attributes:
        max_gap_s: Longer gaps in a track are kept as gaps; shorter ones are filled.
        max_distance_m: An agent farther from the ego is not observed.
        enter_distance_m: Who comes after the history is not observed before it has been
            within it of the ego, and enters there; 0 for wherever it is first seen, as in
            the paper. A simulation can put newcomers into the grid only: it never has
            those who come from beyond, and whoever learns with them misses them.
        near_distance_m: Agents never within it get no motion loss.
        grid_radius_m: Radius of the ego's grid of cells.
        grid_step_m: Spacing of its cells.
        heading_step_deg: Width of a heading bin.
        entry_order: Order of newcomers in a half second: ``distance`` or ``bearing``.
    """

    max_gap_s: float = 1.0
    max_distance_m: float = 150.0
    enter_distance_m: float = 0.0
    near_distance_m: float = 100.0
    grid_radius_m: float = 75.0
    grid_step_m: float = 3.0
    heading_step_deg: float = 3.0
    entry_order: str = "distance"

    def __post_init__(self) -> None:
        """Refuse contradictions.

        Raises:
            ConfigError: naming the setting.
        """
        if self.entry_order not in ("distance", "bearing"):
            raise ConfigError(
                f"tokenize.entry_order is {self.entry_order!r}; "
                "expected 'distance' or 'bearing'"
            )
        bounds = {
            **dict.fromkeys(("max_distance_m", "near_distance_m"), (1, math.inf)),
            "grid_radius_m": (1, math.inf),
            "grid_step_m": (0.1, math.inf),
            "heading_step_deg": (0.1, 360),
        }
        check_numbers(self, "tokenize", bounds)
        if 360 % self.heading_step_deg:
            raise ConfigError(
                f"tokenize.heading_step_deg {self.heading_step_deg} does not divide 360"
            )
