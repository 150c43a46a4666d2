"""Scenes to drive through, the network that drives everyone else, and recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from infgen.rollout.recording import collect
from infgen.rollout.simulator import Simulator
from infgen.scene import Scene
from pipeline.drive.drive import Drive, Submit
from pipeline.drive.world import World
from pipeline.stages.simulation import begin
from pipeline.storage.recordings import About, write_recording
from pipeline.storage.scene_lookup import SceneLookup
from pipeline.storage.scenes import file_name


@dataclass(frozen=True, slots=True)
class Scenes:
    """The scenes that may be chosen.

    Attributes:
        ids: Their ids.
        sources: Names of the files of records that hold them, by id.
        logs: Finds them.
    """

    ids: Sequence[str]
    sources: Mapping[str, str]
    logs: SceneLookup

    def find(self, number: int) -> Scene:
        """Return a scene by its number.

        Raises:
            ValueError: if there is none, or it cannot be read.
        """
        if not 0 <= number < len(self.ids):
            raise ValueError(f"scene {number}, expected 0 to {len(self.ids) - 1}")
        return self.logs.find(self.ids[number])


@dataclass(frozen=True, slots=True)
class Garage:
    """All that a drive needs.

    Attributes:
        simulator: Network and settings.
        weights: Fingerprint of the weights.
        scenes: Where one may drive.
        folder: Where drives are saved.
    """

    simulator: Simulator
    weights: str
    scenes: Scenes
    folder: Path

    def start(self, number: int, seed: int, submit: Submit) -> Drive:
        """Begin a drive: read the scene, feed its history, simulate the first token step.

        Raises:
            ValueError: if the scene cannot be simulated.
        """
        scene = self.scenes.find(number)
        settings = replace(self.simulator.settings, seed=seed, count=1)
        simulator = replace(self.simulator, settings=settings)
        (start,) = begin(simulator, scene)
        return Drive(World(simulator, start), submit)

    def save(self, drive: Drive) -> Path:
        """Write what was driven so far; returns its folder.

        Raises:
            ValueError: if nothing was driven yet.
        """
        start, frames = drive.world.start, list(drive.frames)
        if not frames:
            raise ValueError("nothing was driven yet; expected half a second or more")
        (rollout,) = collect([start], frames, self.weights)
        target = self._free_folder(f"{file_name(rollout.scenario_id)}-{rollout.seed}")
        simulator = drive.world.simulator
        about = About(
            source=self.scenes.sources[rollout.scenario_id],
            simulates=simulator.simulates,
            settings=simulator.settings,
        )
        write_recording(target, rollout, start.scene, about)
        return target

    def _free_folder(self, name: str) -> Path:
        number = 0
        while (path := self.folder / f"{name}-{number:03d}").exists():
            number += 1
        return path
