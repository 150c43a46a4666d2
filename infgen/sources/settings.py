"""Settings of the stage ``ingest``."""

import math
from dataclasses import dataclass

from infgen.coerce import check_numbers


@dataclass(frozen=True, slots=True)
class IngestSettings:
    """How records become scenes.

    Attributes:
        max_scenes_per_shard: Scenes in one Zarr group.
        limit: Scenes to take from each file; 0 for all.
    """

    max_scenes_per_shard: int = 500
    limit: int = 0

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        check_numbers(self, "ingest", {"max_scenes_per_shard": (1, math.inf)})
