"""Settings of what comes after rollouts: logs to hold them against, scores, the report."""

from dataclasses import dataclass

from infgen.clock import CLOCK
from infgen.coerce import ConfigError, check_numbers


@dataclass(frozen=True, slots=True)
class ReferenceSettings:
    """How logs are measured, and with them the rollouts that are scored against them.

    Attributes:
        split: Whose logs; that of the rollouts.
        window_s: Length of a window.
        stride_s: From one window to the next.
        count_radius_m: Agents within it of the ego are counted; ACE is given for it and for
            no limit.
    """

    split: str = "validation"
    window_s: float = 8.0
    stride_s: float = 0.5
    count_radius_m: float = 75.0

    def __post_init__(self) -> None:
        """Refuse what no log can be cut into.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        check_numbers(self, "reference", {})
        for name in ("window_s", "stride_s"):
            try:
                CLOCK.tokens_in(getattr(self, name))
            except ValueError as error:
                raise ConfigError(f"reference.{name}: {error}") from error


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """How rollouts are scored (METRICS.md).

    Attributes:
        presence_radius_m: For models that neither insert nor remove: who crosses this
            distance to the ego enters or leaves, and who is beyond it is not there; 0 for
            never.
        wosac: Version of the Waymo metric, for the first eight seconds.
        resamples: Bootstrap resamples of the scenes behind the 95 % intervals.
        seed: Of the bootstrap.
    """

    presence_radius_m: float = 0.0
    wosac: str = "wosac-2025"
    resamples: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what nothing can be scored with.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        bounds = {"seed": (0, 2**63 - 1)}
        check_numbers(self, "score", bounds)
