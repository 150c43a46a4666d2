"""The rollouts of one scene, and what can be made of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import overload

from infgen.config import RolloutSettings
from infgen.rollout.rollout import Rollout
from infgen.scene import Scene


@dataclass(frozen=True)
class SceneRollouts(Sequence[Rollout]):
    """Simulated futures of one scene; ``rollouts[0]`` is one of them.

    Attributes:
        scene: The log that they continue.
        rollouts: One ``Rollout`` each, in order of their index.
        settings: How they were simulated.
    """

    scene: Scene
    rollouts: tuple[Rollout, ...]
    settings: RolloutSettings

    def __len__(self) -> int:
        return len(self.rollouts)

    def __iter__(self) -> Iterator[Rollout]:
        return iter(self.rollouts)

    @overload
    def __getitem__(self, at: int) -> Rollout: ...

    @overload
    def __getitem__(self, at: slice) -> "SceneRollouts": ...

    def __getitem__(self, at: int | slice) -> "Rollout | SceneRollouts":
        """Return one rollout, or some of them with their scene."""
        if isinstance(at, slice):
            return SceneRollouts(self.scene, self.rollouts[at], self.settings)
        return self.rollouts[at]
