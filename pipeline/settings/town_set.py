"""Settings of the synthetic towns that a preset reads where no records are named."""

from typing import Literal

from pydantic.dataclasses import dataclass

from infgen.settings import RULES, AtLeastOne, Count, Positive, Seed


@dataclass(frozen=True, slots=True, config=RULES)
class TownSet:
    """Synthetic towns of one split."""

    scenes: AtLeastOne
    """Number of scenes."""
    seconds: Positive
    """Length of each."""
    seed: Seed = 0
    """Another seed gives other towns."""
    scenes_per_file: AtLeastOne = 20
    """Most scenes of a file."""
    variety: Literal["basic", "broad", "steady"] = "basic"
    """How much towns differ in streets, drivers and demand."""
    scenes_per_town: Count = 0
    """Scenes of each town; 0 for as many as the variety has."""
