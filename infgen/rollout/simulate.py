"""Rollouts from their starts to their ends, the network driving."""

from collections.abc import Iterator, Sequence

from infgen.clock import CLOCK
from infgen.rollout.recording import Frame, Start
from infgen.rollout.session import Session
from infgen.rollout.simulator import Player


def simulate(player: Player, starts: Sequence[Start]) -> Iterator[Frame]:
    """Play a batch of rollouts, one frame per half second.

    Args:
        player: Network and settings.
        starts: Scenes to continue; several rollouts of one scene share its map.
    """
    session = Session(player, starts)
    for _ in range(CLOCK.tokens_in(player.settings.duration_s)):
        yield session.step()
