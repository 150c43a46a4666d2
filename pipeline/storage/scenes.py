"""Ingested scenes on disk: one Zarr group after the other, in the order of the records."""

import re
from collections.abc import Iterator
from pathlib import Path

from infgen.alignment import align_to_tokens
from infgen.scene import Scene

SCENES_SCHEMA = "infgen.scenes/3"
_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")


def read_scenes(unit_folder: Path, *, aligned: bool = True) -> Iterator[Scene]:
    """Stream the scenes of one ingested file, in the order of its records.

    One group is in memory at a time.

    Args:
        unit_folder: Of the ingested file.
        aligned: As other stages need them, with a history that ends with a token
            (``align_to_tokens``); otherwise as they were ingested.

    Raises:
        StoreError: if a group is damaged.
    """
    from pipeline.storage.zarr_store import read_records  # noqa: PLC0415

    for path in sorted(unit_folder.glob("scenes-*.zarr")):
        for scene in read_records(path, Scene, SCENES_SCHEMA, whole=True):
            yield align_to_tokens(scene) if aligned else scene


def file_name(scenario_id: str) -> str:
    """Name a file after a scene, whatever signs its id has."""
    return _UNSAFE.sub("-", scenario_id).strip(".-") or "scene"
