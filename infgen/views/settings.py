"""Settings of the stage ``report``."""

from dataclasses import dataclass

from infgen.coerce import check_numbers


@dataclass(frozen=True, slots=True)
class ReportSettings:
    """What the report shows.

    Attributes:
        title: Heading of the report.
        players: Of so many of the rollouts with the lowest scores there is a page that
            plays them.
    """

    title: str = "InfGen"
    players: int = 3

    def __post_init__(self) -> None:
        """Refuse what cannot be written.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        check_numbers(self, "report", {})
