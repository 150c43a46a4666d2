"""Rollouts from their starts to their ends, the network driving."""

from collections.abc import Iterator, Sequence

from infgen.clock import CLOCK
from infgen.rollout.recording import Frame, RolloutStart
from infgen.rollout.session import Session
from infgen.rollout.simulator import Simulator


def simulate(simulator: Simulator, starts: Sequence[RolloutStart]) -> Iterator[Frame]:
    """Play a batch of rollouts, one frame per half second.

    Args:
        simulator: Network and settings.
        starts: Scenes to continue; several rollouts of one scene share its map.
    """
    session = Session(simulator, starts)
    for _ in range(CLOCK.tokens_in(simulator.settings.duration_s)):
        yield session.step()
