"""Weights that simulate: whole rollouts of a scene, or a session that a planner drives."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from infgen.config import RolloutSettings
from infgen.rollout.settings import RuleName
from infgen.scene import Scene
from pipeline.api.overrides import RolloutOverrides
from pipeline.api.threads import one_thread
from pipeline.api.weights import find_weights, override
from pipeline.stages.simulation import begin, load_simulator, simulate_all

if TYPE_CHECKING:
    from infgen.rollout.simulator import Simulator
    from pipeline.api.rollouts import SceneRollouts
    from pipeline.api.session import PlannerSession


@dataclass(frozen=True)
class TrafficSimulator:
    """Weights and the settings that they are simulated with.

    The network is read when it is first needed, and kept.

    Attributes:
        folder: Of the weights.
        settings: Of the rollouts.
    """

    folder: Path
    settings: RolloutSettings

    def rollout(
        self,
        scene: Scene,
        *,
        seconds: float | int | None = None,
        count: int | None = None,
        seed: int | None = None,
        rules: RuleName | None = None,
    ) -> "SceneRollouts":
        """Simulate what may happen after the history of a scene.

        On a CPU these are the rollouts of ``infgen rollout`` for the same scene, weights,
        seed, ``count`` and ``batch_rollouts``, bit for bit. On a CUDA device that command
        fills a batch with several scenes, and sums may round differently.

        Args:
            scene: A log; what it holds after ``scene.now`` is not looked at.
            seconds: Length after the history; that of the settings if None.
            count: Number of rollouts; that of the settings if None.
            seed: Seed of all random streams; that of the settings if None.
            rules: ``"none"``: what the network samples is simulated; ``"safe"``: rules over
                its choices keep agents from colliding, leaving the road and stalling, and
                keep their number; those of the settings if None.

        Raises:
            ValueError: if the scene cannot be simulated, with the reason.
        """
        from pipeline.api.rollouts import SceneRollouts  # noqa: PLC0415  # Loads torch.

        simulator = self._with(seconds=seconds, count=count, seed=seed, rules=rules)
        with one_thread():
            starts = begin(simulator, scene)
            groups = simulate_all(simulator, starts, self.weights, lambda _: None)
            rollouts = tuple(one for group in groups for one in group)
        return SceneRollouts(scene, rollouts, simulator.settings)

    def session(
        self,
        scene: Scene,
        *,
        count: int = 1,
        seed: int | None = None,
        rules: RuleName | None = None,
    ) -> "PlannerSession":
        """Begin a rollout of a scene whose ego is driven from outside.

        Args:
            scene: A log; what it holds after ``scene.now`` is not looked at.
            count: Number of rollouts that run side by side, each with an ego of its own.
            seed: Seed of all random streams; that of the settings if None.
            rules: Rules over the choices of the network, as in ``rollout``.

        Raises:
            ValueError: if the scene cannot be simulated, with the reason.
        """
        from pipeline.api.session import PlannerSession  # noqa: PLC0415  # Loads torch.

        simulator = self._with(count=count, seed=seed, rules=rules)
        return PlannerSession(simulator, begin(simulator, scene), self.weights)

    @property
    def simulator(self) -> "Simulator":
        """The network with its settings, as ``infgen.environment`` takes it."""
        return self._loaded[0]

    @property
    def weights(self) -> str:
        """Fingerprint of the weights."""
        return self._loaded[1]

    @cached_property
    def _loaded(self) -> "tuple[Simulator, str]":
        from pipeline.storage.weights import read_description  # noqa: PLC0415  # torch

        identity = str(read_description(self.folder)["weights"])
        return load_simulator(self.folder, identity, self.settings)

    def _with(self, **values: Any) -> "Simulator":
        """Return the simulator with other settings, of which None changes nothing."""
        simulator, _ = self._loaded
        given = {name: value for name, value in values.items() if value is not None}
        return replace(simulator, settings=override(self.settings, given))


def load(
    weights: str | Path = "towns",
    *,
    root: str | Path | None = None,
    **settings: Unpack[RolloutOverrides],
) -> TrafficSimulator:
    """Get weights ready to simulate traffic.

    The settings are those of the last rollouts of these weights in their root, with the
    biases that stage ``calibrate`` found; for the weights of the package those of profile
    ``pretrained``; for a folder that is in no root the defaults. ``rules="safe"`` keeps
    agents from colliding.

    Args:
        weights: ``"towns"``: the weights of the package, trained on synthetic towns; the
            root of a run: its latest weights; a folder with ``model.safetensors`` and
            ``model.json``; or, together with ``root``, the start of a key of stage
            ``train``.
        root: Where to look for the key.
        **settings: Any of ``RolloutSettings``, laid over those.

    Raises:
        ConfigError: if there are no such weights or settings.
    """
    found = find_weights(weights, None if root is None else Path(root))
    return TrafficSimulator(found.folder, override(found.settings, dict(settings)))
