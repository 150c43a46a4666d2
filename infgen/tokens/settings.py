"""Settings of the stage ``tokenize``."""

import math
from dataclasses import dataclass

from infgen.coerce import ConfigError, check_numbers


@dataclass(frozen=True, slots=True)
class TokenSettings:
    """How scenes become tokens (SPEC 1.2, 1.6, 3).

    Attributes:
        max_gap_s: Longer gaps in a track are kept as gaps; shorter ones are filled.
        max_ego_distance_m: An agent farther from the ego is not observed.
        insertion_distance_m: Who comes after the history is not observed before it has been
            within it of the ego, and enters there; 0 for wherever it is first seen, as in
            the paper. A simulation can put newcomers into the grid only: it never has
            those who come from beyond, and whoever learns with them misses them.
        motion_loss_distance_m: Agents never within it get no motion loss.
        grid_radius_m: Radius of the ego's grid of cells.
        grid_cell_m: Spacing of its cells.
        heading_bin_deg: Width of a heading bin.
        insertion_order: Order of newcomers in a half second: ``distance`` or ``bearing``.
    """

    max_gap_s: float = 1.0
    max_ego_distance_m: float = 150.0
    insertion_distance_m: float = 0.0
    motion_loss_distance_m: float = 100.0
    grid_radius_m: float = 75.0
    grid_cell_m: float = 3.0
    heading_bin_deg: float = 3.0
    insertion_order: str = "distance"

    def __post_init__(self) -> None:
        """Refuse contradictions.

        Raises:
            ConfigError: naming the setting.
        """
        if self.insertion_order not in ("distance", "bearing"):
            raise ConfigError(
                f"tokenize.insertion_order is {self.insertion_order!r}; "
                "expected 'distance' or 'bearing'"
            )
        bounds = {
            **dict.fromkeys(
                ("max_ego_distance_m", "motion_loss_distance_m"), (1, math.inf)
            ),
            "grid_radius_m": (1, math.inf),
            "grid_cell_m": (0.1, math.inf),
            "heading_bin_deg": (0.1, 360),
        }
        check_numbers(self, "tokenize", bounds)
        if 360 % self.heading_bin_deg:
            raise ConfigError(
                f"tokenize.heading_bin_deg {self.heading_bin_deg} does not divide 360"
            )
