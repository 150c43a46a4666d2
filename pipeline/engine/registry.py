"""The module of each stage. Modules are imported one by one, as a plan needs them."""

from importlib import import_module

from pipeline.engine.stage import Stage

MODULES = {
    "ingest": "pipeline.stages.ingest",
    "build-vocab": "pipeline.stages.vocabulary",
    "tokenize": "pipeline.stages.tokenize",
    "train": "pipeline.stages.train.stage",
    "calibrate": "pipeline.stages.calibrate",
    "rollout": "pipeline.stages.rollout",
    "reference": "pipeline.stages.reference",
    "score": "pipeline.stages.score.stage",
    "report": "pipeline.stages.report.stage",
}
"""In the order of the data."""


def load_stage(module: str) -> Stage:
    """Return the ``STAGE`` of a module."""
    stage: Stage = import_module(module).STAGE
    return stage
