"""Where data sets differ within the one format of ScenarioNet.

A description does not say what its numbers mean; that follows from the converter that wrote
it. Sources: ScenarioNet (arXiv:2306.12241), its converters, and what its files hold.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from infgen.sources.scene_files import split_in


@dataclass(frozen=True, slots=True)
class Convention:
    """How one data set is written.

    Attributes:
        annotation_hz: Rate of the boxes before they were interpolated to 10 Hz.
        heights: The third coordinate of map lines is a height; nuScenes has the heading of
            the lane there, and a flat map.
        boundary_is_edge: Lines named ``boundary_...`` are outlines of the drivable area,
            in any direction, though their type says a painted line.
        speed_limits: Speed limits are the log's; elsewhere every lane says 100 km/h.
        dense: Lines are as dense as WOMD's.
        ego_sideways: Length and width of the ego are exchanged.
        exact: Every number is a ``Scene``'s own. Elsewhere headings may be unwrapped, and
            states that are not valid hold remains.
        lights: Traffic lights are recorded, so that a scene without any has none.
    """

    annotation_hz: float = 10.0
    heights: bool = True
    boundary_is_edge: bool = False
    speed_limits: bool = True
    dense: bool = False
    ego_sideways: bool = False
    exact: bool = False
    lights: bool = False


CONVENTIONS: Mapping[str, Convention] = {
    "waymo": Convention(dense=True, lights=True),
    "infgen": Convention(dense=True, exact=True, lights=True),
    "nuscenes": Convention(
        annotation_hz=2.0,
        heights=False,
        boundary_is_edge=True,
        speed_limits=False,
        ego_sideways=True,
    ),
    "nuplan": Convention(
        annotation_hz=20.0,
        heights=False,
        boundary_is_edge=True,
        speed_limits=False,
        lights=True,
    ),
}
"""By ``metadata.dataset``; what is not listed is taken as it is, and made dense."""

_NUSCENES_MINI_VALIDATION = ("scene-0103", "scene-0916")
"""Split ``mini_val`` of nuScenes; ``mini_train`` is the rest of its ten scenes."""
_DEFAULT = Convention()


def dataset_of(about: Mapping[str, Any]) -> str:
    """Name the data set that a description is of."""
    name = about.get("dataset")
    return _word(name) if isinstance(name, str) and _word(name) else "scenarionet"


def convention_of(dataset: str) -> Convention:
    """Return how a data set is written."""
    return CONVENTIONS.get(dataset, _DEFAULT)


def split_of(description: Mapping[str, Any], folders: Sequence[str]) -> str:
    """Tell the split of a scene; the data set's name where nothing says.

    In this order: ``metadata.split``; the WOMD file it was converted from; nuScenes' own
    list of its mini split; words such as ``train`` and ``val`` in the names of the file's
    folders, as ScenarioNet's converters write a folder per split.
    """
    about = description.get("metadata")
    about = about if isinstance(about, dict) else {}
    dataset = dataset_of(about)
    told = [about.get(name) for name in ("source_file", "split")]
    if found := split_in([word for word in told if isinstance(word, str)]):
        return found
    if dataset == "nuscenes" and "mini" in str(description.get("version", "")):
        name = about.get("scenario_id", description.get("id"))
        return "validation" if name in _NUSCENES_MINI_VALIDATION else "training"
    return split_in(folders) or dataset


def _word(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:40]
