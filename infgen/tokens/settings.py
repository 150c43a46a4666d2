"""Settings of stage ``tokenize``: how scenes become tokens."""

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from infgen.settings import RULES, Float, NonNegative


@dataclass(frozen=True, slots=True, config=RULES)
class TokenSettings:
    """How scenes become tokens (SPEC 1.2, 1.6, 3)."""

    max_gap_s: NonNegative = 1.0
    """Shorter gaps in a track are filled; longer ones are kept as gaps."""
    max_ego_distance_m: Annotated[Float, Field(ge=1)] = 150.0
    """Agents farther from the ego are not observed."""
    insertion_distance_m: NonNegative = 0.0
    """An agent that appears after the history is not observed before it has been within
    this distance of the ego, and is inserted there; 0 to insert it where it is first seen,
    as in the paper. A simulation inserts agents into the grid only, so a network that
    learns from agents that come from beyond it misses them."""
    motion_loss_distance_m: Annotated[Float, Field(ge=1)] = 100.0
    """Agents that are never within this distance of the ego have no motion loss."""
    grid_radius_m: Annotated[Float, Field(ge=1)] = 75.0
    """Radius of the occupancy grid around the ego."""
    grid_cell_m: Annotated[Float, Field(ge=0.1)] = 3.0
    """Spacing of its cells."""
    heading_bin_deg: Annotated[Float, Field(ge=0.1, le=360)] = 3.0
    """Width of a heading bin."""
    insertion_order: Literal["distance", "bearing"] = "distance"
    """Order of the agents that are inserted in one token step."""

    @model_validator(mode="after")
    def _check(self) -> "TokenSettings":
        if 360 % self.heading_bin_deg:
            raise ValueError(f"heading_bin_deg={self.heading_bin_deg} does not divide 360")
        return self
