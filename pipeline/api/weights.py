"""Where weights are, and the settings that they are simulated with."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from infgen.config import RolloutSettings
from infgen.errors import ConfigError
from infgen.pretrained import builtin_weights
from infgen.rollout.rules.rule_set import RULE_SETS
from infgen.settings import build
from pipeline.engine.layout import Root
from pipeline.engine.manifest import read_manifest
from pipeline.settings.request import complete_request
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from pipeline.stages.calibration import Biases, read_found
from pipeline.storage.initial_weights import BUILTIN, DESCRIPTION, find_initial_weights

TOWNS = "towns"
"""The weights that come with the package, by the name of their data."""
PROFILE = "pretrained"
"""The profile of the settings that go with them."""


@dataclass(frozen=True, slots=True)
class FoundWeights:
    """Weights on disk.

    Attributes:
        folder: Holds ``model.safetensors`` and ``model.json``.
        settings: Of their rollouts, the biases that stage ``calibrate`` found included.
    """

    folder: Path
    settings: RolloutSettings


def find_weights(weights: str | Path, root: Path | None) -> FoundWeights:
    """Find weights by name, folder or key, and how they are simulated.

    Raises:
        ConfigError: if there are none, naming what was expected.
    """
    if root is not None:
        named = find_initial_weights(root.absolute(), "weights", str(weights))
        return _in_folder(Path(named[0].url))
    if str(weights) in (TOWNS, BUILTIN):
        return _in_folder(builtin_weights())
    folder = Path(weights).absolute()
    if Root(folder).store.is_dir():
        trained = Root(folder).latest_folder("train")
        if trained is None:
            raise ConfigError(
                f"{folder} holds no trained weights; `infgen train --root {folder}` trains "
                "some"
            )
        return _in_folder(trained)
    if not (folder / DESCRIPTION).is_file():
        raise ConfigError(
            f"no weights {str(weights)!r}; expected {TOWNS!r} (those of the package), the "
            f"root of a run, a folder with {DESCRIPTION}, or the start of a key of stage "
            "train together with root="
        )
    return _in_folder(folder)


def override(settings: RolloutSettings, values: dict[str, Any]) -> RolloutSettings:
    """Lay values over settings; with other rules come all rules of that set.

    Raises:
        ConfigError: for a setting that does not exist or cannot have its value.
    """
    if values.get("rules") in RULE_SETS:
        settings = settings.with_rules(values["rules"])
    return build(RolloutSettings, {**asdict(settings), **values}, "rollout")


def _in_folder(folder: Path) -> FoundWeights:
    """Find the settings that go with a folder of weights."""
    folder = folder.resolve()
    if folder == builtin_weights().resolve():
        chosen = load_stages(DEFAULT_FILE, {}).choose(PROFILE)
        return FoundWeights(folder, chosen.build("rollout", RolloutSettings))
    root = Root(folder.parents[2])
    if folder.parent != root.stage("train"):
        return FoundWeights(folder, RolloutSettings())
    key = read_manifest(folder)["key"]
    settings, calibrated = _played(root, key) or _requested(root, key)
    found = Biases()
    if calibrated and root.is_finished("calibrate", calibrated):
        found = read_found(root.folder("calibrate", calibrated))
    return FoundWeights(folder, found.used_by(settings).over(settings))


def _played(root: Root, key: str) -> tuple[RolloutSettings, str] | None:
    """Settings and calibration of the root's latest rollouts, if they are of a key."""
    folder = root.latest_folder("rollout")
    manifest = read_manifest(folder) if folder is not None else {"inputs": {}}
    if manifest["inputs"].get("train") != key:
        return None
    settings = build(RolloutSettings, manifest["settings"]["rollout"], str(folder))
    return settings, manifest["inputs"].get("calibrate", "")


def _requested(root: Root, key: str) -> tuple[RolloutSettings, str]:
    """Settings and calibration as the root's last request has them, if it is of a key."""
    request = complete_request(
        root, file=None, profile=None, records=(), overrides=(), environ={}
    )
    keys = request.made()
    if keys.get("train") != key:
        return RolloutSettings(), ""
    chosen = request.stages({}).choose(request.profile, request.overrides)
    return chosen.build("rollout", RolloutSettings), keys.get("calibrate", "")
