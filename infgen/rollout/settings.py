"""Settings of rollouts: what is played, how choices are sampled, and who may enter."""

import math
from dataclasses import dataclass

from infgen.clock import CLOCK
from infgen.coerce import ConfigError, check_numbers


@dataclass(frozen=True, slots=True)
class RolloutMode:
    """What one word for a kind of rollout stands for.

    Attributes:
        seconds: Length.
        everyone: Whether everyone of the log is played, however far from the ego.
        insert: Whether agents may enter.
        remove: Whether agents may leave.
        fixed: Names of those of the above that a setting of their own must not change.
    """

    seconds: float
    everyone: bool
    insert: bool
    remove: bool
    fixed: tuple[str, ...]


MODES = {
    "long": RolloutMode(30.0, False, True, True, ()),
    "motion-only": RolloutMode(30.0, False, False, False, ("insert", "remove")),
    "wosac": RolloutMode(
        8.0, True, False, False, ("seconds", "everyone", "insert", "remove")
    ),
}
"""``long``: agents come and go. ``motion-only``: nobody does (the paper's table 3).
``wosac``: Waymo's protocol, which fixes all four."""


@dataclass(frozen=True, slots=True)
class RolloutSettings:
    """How futures are played (SPEC 6).

    What the mode leaves open, ``seconds``, ``everyone``, ``insert`` and ``remove`` may say
    otherwise; where the mode fixes it, another value is an error.

    Attributes:
        split: Split whose scenes are played (start of the file name).
        mode: ``long``, ``motion-only`` or ``wosac``: see ``MODES``.
        seconds: Length of a rollout after the history; the mode's if None.
        count: Rollouts per scene.
        scenes: Scenes to play, evenly spread over those of the split; 0 for all.
        scenes_per_unit: Scenes of one unit of work.
        batch: Rollouts that are played at once.
        everyone: Whether to play every agent of the log that is there at now, however far
            from the ego, or those within ``tokenize.max_ego_distance_m``; the mode's if
            None.
        insert: Whether agents may enter; the mode's if None.
        remove: Whether agents may leave; the mode's if None.
        removal_radius_m: Whoever gets farther from the ego leaves, if anyone may; 0 for
            nobody. For weights that do not say who leaves (SPEC 7).
        lights: What traffic lights show after the history, to weights that see them change:
            ``now`` for nothing but what they showed last, ``log`` for what they do in the
            log while it goes on. Not in mode ``wosac``, which forbids to look.
        patterns: Whether agents are seen and lost as by a detector, with weights that have
            learned validity patterns.
        motion_top_k: Most likely moves that are sampled from; 0 for all.
        position_top_k: Most likely cells that are sampled from; 0 for all.
        motion_top_p: Least share of probability that the moves sampled from have together,
            the most likely first; 1 for all. Moves that stand still and those that do not
            have a nucleus each and keep their probability: who seldom sets off still does.
        position_top_p: The same for cells.
        max_motion_samples: Moves that are drawn for who would run into somebody ahead
            within 1.5 s, everybody going on alike, until one does not lead there; 1 for
            whatever is drawn first, as in the paper.
        reject_off_road: Whether half of these draws are also for vehicles that would leave
            the road before they could stop, or go farther off it. Who is more than a metre
            off may; who is too fast for every draw takes the slowest.
        max_stall_s: Vehicles that have stood in a lane for so long set off, unless a light
            that is not green is ahead or they would run into somebody; 0 for who stands as
            long as it likes, as in the paper. A network that looks back for a few seconds
            takes whoever has stood all of them for parked.
        motion_temperature: Logits of moves are divided by it: below 1 the likely become
            likelier.
        position_temperature: The same for cells.
        heading_temperature: The same for heading bins.
        add_bias: Added to the log-odds that one more agent enters, on top of what stage
            ``calibrate`` finds.
        remove_bias: The same for an agent's leaving.
        density_control: How firmly the number of agents around the ego is held to what it
            was at now: the odds that one more enters are multiplied by that number, over
            the number there is, to this power; 0 for not at all, as in the paper. A network
            that looks back for a few seconds forgets how full the street was. Where a map
            ends there are to be fewer.
        insertion_mask: Whether newcomers are kept off other boxes, also off where these
            will be in half a second, and vehicles near lanes. The paper lets them in
            anywhere.
        insertion_lane_distance_m: Farthest from a lane's middle that a vehicle may enter.
            Most logged newcomers are parked cars that come into view: of all, 47 % are
            within 5 m, 69 % within 10 m, 78 % within 15 m; of those that drive, 96, 97 and
            97 %.
        max_insertion_attempts: Cells that are tried for one newcomer before there is none.
        max_insertions: Newcomers per half second.
        max_agents: Agents at any one time; or as many as a scene has at now, if more.
        seed: Of all random streams.
    """

    split: str = "validation"
    mode: str = "long"
    seconds: float | None = None
    count: int = 32
    scenes: int = 0
    scenes_per_unit: int = 8
    batch: int = 32
    everyone: bool | None = None
    insert: bool | None = None
    remove: bool | None = None
    removal_radius_m: float = 0.0
    lights: str = "now"
    patterns: bool = False
    motion_top_k: int = 5
    position_top_k: int = 10
    motion_top_p: float = 1.0
    position_top_p: float = 1.0
    max_motion_samples: int = 1
    reject_off_road: bool = False
    max_stall_s: float = 0.0
    motion_temperature: float = 1.0
    position_temperature: float = 1.0
    heading_temperature: float = 1.0
    add_bias: float = 0.0
    remove_bias: float = 0.0
    density_control: float = 0.0
    insertion_mask: bool = True
    insertion_lane_distance_m: float = 15.0
    max_insertion_attempts: int = 4
    max_insertions: int = 16
    max_agents: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse contradictions.

        Raises:
            ConfigError: naming the setting, its value and the way out.
        """
        if self.mode not in MODES:
            raise ConfigError(
                f"rollout.mode is {self.mode!r}; expected {' or '.join(MODES)}"
            )
        for name in MODES[self.mode].fixed:
            given, fixed = getattr(self, name), getattr(MODES[self.mode], name)
            if given is not None and given != fixed:
                raise ConfigError(
                    f"rollout.{name} is {given}, but rollout.mode={self.mode} is played "
                    f"with {fixed}; say so, leave it out, or choose another mode"
                )
        if self.lights not in ("now", "log"):
            raise ConfigError(f"rollout.lights is {self.lights!r}; expected now or log")
        if self.lights == "log" and self.mode == "wosac":
            raise ConfigError(
                "rollout.lights=log looks into the future, which rollout.mode=wosac "
                "forbids; say rollout.lights=now"
            )
        if self.reject_off_road and self.max_motion_samples < 2:
            raise ConfigError(
                "rollout.reject_off_road samples again, but rollout.max_motion_samples "
                f"is {self.max_motion_samples}; say rollout.max_motion_samples=32 too"
            )
        if self.max_stall_s and self.max_motion_samples < 2:
            raise ConfigError(
                f"rollout.max_stall_s is {self.max_stall_s}, but "
                f"rollout.max_motion_samples is {self.max_motion_samples}: a released "
                "vehicle may collide; say rollout.max_motion_samples=32 too"
            )
        self._check_numbers()

    def _check_numbers(self) -> None:
        for name in ("motion_temperature", "position_temperature", "heading_temperature"):
            if not getattr(self, name) > 0:
                raise ConfigError(
                    f"rollout.{name} is {getattr(self, name)}; expected more than 0 "
                    "(for the most likely alone, say rollout.motion_top_k=1)"
                )
        for name in ("motion_top_p", "position_top_p"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(
                    f"rollout.{name} is {getattr(self, name)}; expected up to 1, above 0"
                )
        one_or_more = (
            "count", "scenes_per_unit", "batch",
            "max_motion_samples", "max_insertion_attempts", "max_agents",
        )  # fmt: skip
        bounds = {
            **dict.fromkeys(one_or_more, (1, math.inf)),
            **dict.fromkeys(("add_bias", "remove_bias"), (-math.inf, math.inf)),
            "seed": (0, 2**63 - 1),
        }
        check_numbers(self, "rollout", bounds)
        try:
            CLOCK.tokens_in(self.duration_s)
        except ValueError as error:
            raise ConfigError(f"rollout.seconds: {error}") from error

    @property
    def duration_s(self) -> float:
        """Seconds that are played."""
        return MODES[self.mode].seconds if self.seconds is None else self.seconds

    @property
    def simulates_all_agents(self) -> bool:
        """Whether agents however far away are played."""
        return MODES[self.mode].everyone if self.everyone is None else self.everyone

    @property
    def inserts(self) -> bool:
        """Whether agents may enter."""
        return MODES[self.mode].insert if self.insert is None else self.insert

    @property
    def removes(self) -> bool:
        """Whether agents may leave."""
        return MODES[self.mode].remove if self.remove is None else self.remove
