"""Settings of stage ``ingest``: how records become scenes."""

from pydantic.dataclasses import dataclass

from infgen.settings import RULES, AtLeastOne, Count


@dataclass(frozen=True, slots=True, config=RULES)
class IngestSettings:
    """How records become scenes."""

    max_scenes_per_shard: AtLeastOne = 500
    """Scenes in one Zarr group."""
    max_scenes_per_file: Count = 0
    """Scenes to take from each file, or group of scene files; 0 for all."""
    now_step: Count = 0
    """Last step of the history in scenes of Argoverse 2 and ScenarioNet; 0 for that of the
    source (49 in motion forecasting, the description's own or 10 elsewhere). WOMD's records
    always have their own."""
