"""What stages before those that play leave on disk."""

from infgen.config import ModelSettings
from pipeline.stages.calibration import Biases, write_found

TINY = ModelSettings(
    width=16, heads=2, map_blocks=1, motion_blocks=1, scene_blocks=1, fourier_bands=4
)


class Finished:
    """Inputs of a stage that plays: what earlier stages left on disk."""

    sources = ()

    def __init__(self, scenes, weights):
        self.scenes, self.weights = scenes, weights
        self.calibrated = weights.parent / "calibrate"
        self.calibrated.mkdir(exist_ok=True)
        write_found(self.calibrated, Biases())

    def units(self, name):
        return {"ingest": self.scenes}[name]

    def folder(self, name):
        return {"train": self.weights, "calibrate": self.calibrated}[name]

    def content(self, name, *names):
        return f"content of {name}"

    def key(self, name):
        raise AssertionError("a key changes more often than what the stage reads")
