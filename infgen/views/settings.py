"""Settings of stage ``report``: what it shows."""

from pydantic.dataclasses import dataclass

from infgen.settings import RULES, Count


@dataclass(frozen=True, slots=True, config=RULES)
class ReportSettings:
    """What the report shows."""

    title: str = "InfGen"
    """Heading of the report."""
    player_pages: Count = 3
    """Number of player pages: one for each of the rollouts with the lowest scores."""
