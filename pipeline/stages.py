"""Which module holds which stage. Imported one by one, as a plan needs them."""

from importlib import import_module

from pipeline.stage import Stage

MODULES = {
    "ingest": "pipeline.ingest",
    "build-vocab": "pipeline.vocabulary",
    "tokenize": "pipeline.tokenize",
    "train": "pipeline.train",
    "calibrate": "pipeline.calibrate",
    "rollout": "pipeline.rollout",
    "reference": "pipeline.reference",
    "score": "pipeline.score",
    "report": "pipeline.report",
}
"""In the order in which data takes its way."""


def load_stage(module: str) -> Stage:
    """Return the ``STAGE`` of a module."""
    stage: Stage = import_module(module).STAGE
    return stage
