"""Sources that change while they are read.

The identity of a source, and with it the key of what is made of it, is found before a unit
reads it, perhaps hours before. A file that is replaced or appended to in between would be
kept under the key of another content.
"""

from collections.abc import Mapping
from typing import Any

from pipeline.engine.atomic import StoreError
from pipeline.storage.sources.fingerprints import fingerprint_again
from pipeline.storage.sources.scene_groups import fingerprint_group, scene_of


class ChangedSourceError(StoreError):
    """A source is not what it was when the work was planned."""


def check_unchanged(name: str, task: Mapping[str, Any], expected: str) -> None:
    """Check, after it was read, that a source still is what was planned.

    Args:
        name: Of the unit.
        task: Its ``url``, or ``scenes``: parts of a group.
        expected: Identity of the source when the work was planned.

    Raises:
        ChangedSourceError: naming it, if it is not.
        OSError: if it is gone.
    """
    if "scenes" in task:
        members = [scene_of(part) for part in task["scenes"]]
        found, place = fingerprint_group(members, fingerprint_again), f"a file of {name}"
    else:
        found, place = fingerprint_again(task["url"], expected), task["url"]
    if found != expected:
        raise ChangedSourceError(
            f"{place} changed after this run had begun (its content is {found}, expected "
            f"{expected}); nothing of it is kept: run again when it no longer changes"
        )
