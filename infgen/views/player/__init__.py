"""One-file player of logs and rollouts."""

from infgen.views.player.page import player_page

__all__ = ["player_page"]
