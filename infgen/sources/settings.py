"""Settings of stage ``ingest``: how records become scenes."""

from pydantic.dataclasses import dataclass

from infgen.settings import RULES, AtLeastOne, Count


@dataclass(frozen=True, slots=True, config=RULES)
class IngestSettings:
    """How records become scenes."""

    max_scenes_per_shard: AtLeastOne = 500
    """Scenes in one Zarr group."""
    max_scenes_per_file: Count = 0
    """Scenes to take from each file; 0 for all."""
