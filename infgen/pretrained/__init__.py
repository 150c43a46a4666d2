"""Weights that come with the package: trained on synthetic towns, free of any licence.

``towns/model.safetensors`` holds them with their vocabularies, ``towns/model.json`` says
what they are; ``docs/results.md`` has the commands that made them.
"""

from pathlib import Path


def builtin_weights() -> Path:
    """Return the folder of the weights."""
    return Path(__file__).parent / "towns"
