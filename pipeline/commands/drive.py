"""``infgen drive``: a local page where the ego is driven by hand.

What is not named is found: weights of the root or of the package, scenes of the root or the
built-in ones, settings of the root's last run.
"""

import asyncio
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.pretrained import builtin_weights
from pipeline.engine import signals
from pipeline.engine.layout import Root
from pipeline.settings.overlay import Overlay, SettingValue, merge_overlays
from pipeline.settings.request import Request
from pipeline.settings.stages_file import StagesFile
from pipeline.stages.calibration import read_found
from pipeline.stages.simulation import load_simulator
from pipeline.storage.scene_lookup import open_scene_lookup
from pipeline.storage.scene_rollouts import choose, units_of_scenes
from pipeline.storage.sources.raw_scenes import RawScene, RecordPlace, iter_raw_scenes
from pipeline.storage.sources.source_files import BUILTIN, find_records

if TYPE_CHECKING:
    from pipeline.drive.garage import Garage, Scenes

PRETRAINED = "pretrained"
"""Profile with the settings that go with the weights of the package."""
_SAFE = SettingValue("safe", "infgen drive: rollout")
DEFAULTS = Overlay((), {"rollout": {"rules": _SAFE}})
"""Settings of a drive, unless a profile or a word of the command has others."""
MOST_SCENES = 200
"""Scenes that the page lets choose from."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is driven, and where the page is.

    Attributes:
        request: The root, records and settings.
        file: The stages and profiles of the request.
        profile: Profiles that the command names, if any.
        scene: Start of the id of the first scene; empty for the first there is.
        records: Records to drive through; empty for the root's scenes.
        weights: Folder of weights, ``builtin``, or empty for the root's.
        seed: Of the first drive.
        out: Folder to save drives in; None for ``drives`` below the root.
        port: Of the page; 0 for any free one.
        browser: Whether a browser is opened.
    """

    request: Request
    file: StagesFile
    profile: str | None = None
    scene: str = ""
    records: tuple[str, ...] = ()
    weights: str = ""
    seed: int = 0
    out: Path | None = None
    port: int = 0
    browser: bool = True

    @property
    def root(self) -> Root:
        """The root of the experiment."""
        return self.request.root


def drive(wanted: Wanted, say: Callable[[str], None], log: Callable[[str], None]) -> None:
    """Serve the page until a signal arrives.

    Args:
        wanted: What is driven.
        say: Hears the address of the page.
        log: Hears what was refused or saved.

    Raises:
        ConfigError: if there is no such scene, or the extra is not installed.
        StoreError: if there are no weights.
        ValueError: if the scene cannot be simulated.
        Stopped: when a signal arrives.
    """
    if find_spec("tornado") is None:
        raise ConfigError("infgen drive needs tornado: pip install 'infgen[drive]'")
    from pipeline.drive.server import serve  # noqa: PLC0415

    def opened(url: str) -> None:
        say(url)
        if wanted.browser:
            webbrowser.open(url)

    garage, number = open_garage(wanted)
    with signals.deferred():
        asyncio.run(serve(garage, number, wanted.seed, wanted.port, opened, log))


def open_garage(wanted: Wanted) -> "tuple[Garage, int]":
    """Load weights and list scenes; returns the number of the first scene as well.

    Raises:
        ConfigError: if there is no such scene.
        StoreError: if there are no weights.
    """
    from pipeline.drive.garage import Garage  # noqa: PLC0415

    folder = _find_weights(wanted)
    scenes = _find_scenes(wanted)
    scenario_id = choose(scenes.ids, wanted.scene, "those that may be driven through")
    simulator, weights = load_simulator(folder, "", _settings(wanted, folder))
    out = wanted.out or wanted.root.path / "drives"
    return Garage(simulator, weights, scenes, out), scenes.ids.index(scenario_id)


def _find_weights(wanted: Wanted) -> Path:
    if wanted.weights not in ("", BUILTIN):
        return Path(wanted.weights).absolute()
    trained = wanted.root.latest_folder("train") if not wanted.weights else None
    return trained or builtin_weights()


def _settings(wanted: Wanted, weights: Path) -> RolloutSettings:
    """Return the settings that rollouts of these weights have."""
    own = weights == builtin_weights()
    profile = wanted.profile or (PRETRAINED if own else wanted.request.profile)
    chosen = wanted.file.choose(profile, wanted.request.overrides)
    over = merge_overlays([DEFAULTS, chosen])
    settings: RolloutSettings = over.build("rollout", RolloutSettings)
    calibrated = wanted.root.latest_folder("calibrate")
    if calibrated is not None and weights == wanted.root.latest_folder("train"):
        settings = read_found(calibrated).over(settings)
    return replace(settings, count=1, recordings="")


def _find_scenes(wanted: Wanted) -> "Scenes":
    from pipeline.drive.garage import Scenes  # noqa: PLC0415

    made = None if wanted.records else wanted.root.latest_folder("ingest")
    if made is not None:
        sources = units_of_scenes(made, "source")
        ids = _some(list(sources), wanted.scene)
        return Scenes(ids, sources, open_scene_lookup([str(made)]))
    patterns = wanted.records or (BUILTIN,)
    sources = _sources_of_records(patterns, wanted.scene)
    if not sources:
        raise ConfigError(f"{', '.join(patterns)}: no usable record")
    return Scenes(list(sources), sources, open_scene_lookup(patterns))


def _some(ids: Sequence[str], prefix: str) -> list[str]:
    """Return the first ids, and those that start as is wanted."""
    first = ids[:MOST_SCENES]
    wanted = (each for each in ids[MOST_SCENES:] if prefix and each.startswith(prefix))
    return [*first, *islice(wanted, MOST_SCENES)]


def _sources_of_records(patterns: Sequence[str], prefix: str) -> dict[str, str]:
    """Read ids and file names of records, as far as is needed."""
    found: dict[str, str] = {}
    for raw in iter_raw_scenes(find_records(patterns), []):
        if len(found) < MOST_SCENES or (prefix and raw.scenario_id.startswith(prefix)):
            found.setdefault(raw.scenario_id, _source(raw))
        missing = prefix and not any(each.startswith(prefix) for each in found)
        if len(found) >= MOST_SCENES and not missing:
            return found
    return found


def _source(raw: RawScene) -> str:
    """Name of the file of records that holds a scene."""
    if isinstance(raw.place, RecordPlace):
        return raw.place.url.rsplit("/", 1)[-1]
    return raw.place.files.name
