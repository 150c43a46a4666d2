"""Initial weights of a stage: of the package, of a folder, or of a key."""

from pathlib import Path

from infgen.errors import ConfigError
from infgen.pretrained import builtin_weights
from pipeline.engine.layout import KEY_DIGITS, Root, read_json
from pipeline.engine.stage import Source

WEIGHTS, DESCRIPTION = "model.safetensors", "model.json"
BUILTIN = "builtin"
"""The word for the weights that come with the package."""
INITIAL_WEIGHTS = "initial_weights"
"""Name of the initial weights among a stage's sources."""


def find_initial_weights(root: Path, setting: str, named: str) -> list[Source]:
    """Find the weights that a setting names.

    Args:
        root: Of the experiment.
        setting: Its name, for errors.
        named: ``builtin``, a folder, or the start of a key of stage ``train``; or nothing.

    Returns:
        One source, or none where nothing is named.

    Raises:
        ConfigError: if there are none, or the key is of several.
    """
    if not named:
        return []
    stage = Root(root).stage("train")
    keyed = [path for path in stage.glob("*") if path.name.startswith(named[:KEY_DIGITS])]
    own = [builtin_weights()] if named == BUILTIN else [Path(named).absolute()]
    found = [place for place in (*own, *sorted(keyed)) if (place / DESCRIPTION).is_file()]
    if len(found) != 1:
        why = "several have it" if found else "there is no such folder or key"
        raise ConfigError(
            f"{setting} is {named!r}, but {why}; expected {BUILTIN!r}, a folder with "
            f"{WEIGHTS} and {DESCRIPTION}, or the start of a key below {stage}"
        )
    folder = found[0].resolve()
    return [
        Source(str(folder), INITIAL_WEIGHTS, _fingerprint(folder / DESCRIPTION, setting))
    ]


def _fingerprint(path: Path, setting: str) -> str:
    about = read_json(path)
    if not isinstance(about, dict) or "weights" not in about:
        raise ConfigError(
            f"{setting}: {path} lacks the entry 'weights'; expected a folder that stage "
            f"'train' made, with {WEIGHTS} and the {DESCRIPTION} that describes them"
        )
    return str(about["weights"])
