"""Settings of stage ``rollout``: what is simulated and how choices are sampled."""

from dataclasses import dataclass as plain_dataclass
from dataclasses import fields, replace
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from infgen.clock import CLOCK
from infgen.rollout.rules.rule_set import RULE_SETS, RuleSet
from infgen.settings import (
    NOT_IN_KEY,
    RULES,
    AtLeastOne,
    Bool,
    Count,
    Float,
    NonNegative,
    Nucleus,
    Seed,
)

Temperature = Annotated[Float, Field(gt=0)]


@plain_dataclass(frozen=True, slots=True)
class RolloutMode:
    """What one word for a kind of rollout stands for.

    Attributes:
        seconds: Length after the history.
        all_agents: Whether all agents of the log are simulated, however far from the ego.
        insert: Whether agents are inserted.
        remove: Whether agents are removed.
        fixed: Names of those of the above that no setting may change.
    """

    seconds: float
    all_agents: bool
    insert: bool
    remove: bool
    fixed: tuple[str, ...]


MODES = {
    "long": RolloutMode(30.0, False, True, True, ()),
    "motion-only": RolloutMode(30.0, False, False, False, ("insert", "remove")),
    "wosac": RolloutMode(
        8.0, True, False, False, ("seconds", "all_agents", "insert", "remove")
    ),
}
"""``long``: agents are inserted and removed. ``motion-only``: none are (the paper's table
3). ``wosac``: Waymo's protocol, which fixes all four."""
RuleName = Literal["none", "safe"]
RULE_NAMES = tuple(field.name for field in fields(RuleSet))
"""Settings of single rules, in the order of the table in ``docs/rules.md``."""


@dataclass(frozen=True, slots=True, config=RULES)
class RolloutSettings:
    """How scenes are simulated (SPEC 6).

    `seconds`, `all_agents`, `insert` and `remove` overrule what the mode says. Where the
    mode fixes one of them, another value is an error. In the same way the settings of
    single rules overrule what `rules=safe` says, and `rules=none` fixes all of them.
    """

    split: str = "validation"
    """Split whose scenes are simulated (start of the file name)."""
    mode: Literal["long", "motion-only", "wosac"] = "long"
    """`long` inserts and removes agents for 30 s, `motion-only` does neither, `wosac` is
    Waymo's protocol of 8 s."""
    seconds: Float | None = None
    """Length of a rollout after the history; that of the mode if not set."""
    count: AtLeastOne = 32
    """Rollouts per scene."""
    max_scenes: Count = 0
    """Scenes to simulate, evenly spread over the split; 0 for all."""
    scenes_per_unit: AtLeastOne = 8
    """Scenes of one unit of work."""
    batch_rollouts: AtLeastOne = 32
    """Rollouts that are simulated at once: on a CPU those of one scene, on a CUDA device
    those of several. A batch that does not fit into the memory of a CUDA device is
    simulated as smaller ones."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the network computes. `auto` is `cuda` if the process that plans the rollouts
    has a CUDA device, else `cpu`. All units of one run use devices of one type; a worker
    without it refuses its units."""
    precision: Literal["auto", "float32", "bf16"] = "auto"
    """Precision of matrix products. `auto` is float32 on a CPU and TF32 on a CUDA device,
    `float32` is exact on both, `bf16` is bfloat16 by autocast on both. Poses, distances and
    sampling are float32 or float64 in all of them. Choices differ between precisions, as
    between devices, where two are about equally likely."""
    cuda_graphs: Annotated[Bool, NOT_IN_KEY] = False
    """Whether passes of insertion on a CUDA device are captured as CUDA graphs: what is
    simulated is the same. Not run on a GPU yet."""
    all_agents: Bool | None = None
    """Whether to simulate all agents that the log has at the end of the history, however
    far from the ego, or those within `tokenize.max_ego_distance_m`; as the mode says if not
    set."""
    insert: Bool | None = None
    """Whether agents are inserted; as the mode says if not set."""
    remove: Bool | None = None
    """Whether agents are removed; as the mode says if not set."""
    removal_radius_m: NonNegative = 0.0
    """An agent that gets farther from the ego is removed, where the mode removes; 0 for no
    limit. For weights without remove tokens (SPEC 7)."""
    signals: Literal["now", "log"] = "now"
    """What traffic signals show after the history, to weights with
    `model.signals_each_step`: `now` for what they showed last, `log` for what the log
    shows as long as it goes on. Mode `wosac` forbids `log`."""
    validity_patterns: Bool = False
    """Whether agents are detected and missed as by a detector, with weights that have
    `model.validity_pattern_tokens`."""
    motion_top_k: Count = 5
    """Number of the most likely motion tokens that are sampled from; 0 for all."""
    position_top_k: Count = 10
    """Number of the most likely position tokens that are sampled from; 0 for all."""
    motion_top_p: Nucleus = 1.0
    """Motion tokens are sampled from the nucleus: the most likely ones that together have
    this probability; 1 for all. Tokens that stand still and tokens that move have a nucleus
    each and keep their probability, so that an agent that seldom sets off still does."""
    position_top_p: Nucleus = 1.0
    """The same for position tokens."""
    offset_top_p: Nucleus = 1.0
    """The same for offset tokens (`model.offset_token`). What is beyond the nucleus lies
    between the lane and the road edge, where none stands."""
    heading_top_p: Nucleus = 1.0
    """The same for heading tokens."""
    rules: RuleName = "none"
    """Rules over the network's choices. `none`: what it samples is simulated. `safe`:
    agents avoid collisions, stay on the road, do not stall, keep their number, and are
    inserted clear of others. The settings from `max_motion_samples` to
    `max_insertion_attempts` change single rules of `safe`."""
    max_motion_samples: AtLeastOne | None = None
    """A motion token is rejected and sampled again, up to so often, if the agent would hit
    one ahead of it within 1.5 s, all agents going on alike; 1 to accept the first. As
    `rules` says if not set: `none` 1, `safe` 32."""
    reject_off_road: Bool | None = None
    """Whether motion tokens of vehicles that would leave the road before they could stop,
    or get farther off it, are rejected too, for half of these samples. A vehicle that is
    more than a metre off the road is exempt. If all samples are rejected, the slowest is
    taken. As `rules` says if not set: `none` false, `safe` true."""
    max_stall_s: NonNegative | None = None
    """A vehicle that has stood in a lane for so long sets off, unless a signal ahead is not
    green or it would hit an agent; 0 for no limit. A network that sees a few seconds of the
    past takes a vehicle that stood all of them for parked. As `rules` says if not set:
    `none` 0, `safe` 20."""
    density_control: NonNegative | None = None
    """How firmly the number of agents around the ego is held at what it was at the end of
    the history: the odds of one more insertion are multiplied by that number over the
    present one, to this power; 0 for not at all. A network that sees a few seconds of the
    past forgets how dense traffic was. Where a map ends fewer are aimed at. As `rules` says
    if not set: `none` 0, `safe` 1."""
    insertion_mask: Bool | None = None
    """Whether agents are inserted only clear of other boxes, now and one token step later,
    and vehicles only near lanes. As `rules` says if not set: `none` false, `safe` true."""
    insertion_lane_distance_m: NonNegative | None = None
    """Largest distance from a lane's centre at which a vehicle is inserted. Most insertions
    of the logs are parked cars that come into view: of all, 47 % are within 5 m, 69 %
    within 10 m, 78 % within 15 m; of those that drive, 96, 97 and 97 %. As `rules` says if
    not set: `none` no limit, `safe` 25."""
    max_insertion_attempts: AtLeastOne | None = None
    """Position tokens that are sampled for one agent before its insertion is given up,
    where `insertion_mask` rejects some. As `rules` says if not set: `none` 1, `safe` 16."""
    motion_temperature: Temperature = 1.0
    """Motion logits are divided by it: below 1 the likely tokens become likelier (for the
    most likely one alone, set `rollout.motion_top_k=1`)."""
    position_temperature: Temperature = 1.0
    """The same for position tokens."""
    heading_temperature: Temperature = 1.0
    """The same for heading bins."""
    add_bias: Float = 0.0
    """Added to the log-odds that one more agent is inserted, on top of what stage
    `calibrate` finds."""
    remove_bias: Float = 0.0
    """The same for the removal of an agent."""
    latent_rate_scale: NonNegative = 0.5
    """Standard deviations of latent rates (`model.latent_rates`) are multiplied by it,
    means by its square; 0 for no latent rates. At 1 rates vary as in logs, but numbers of
    agents more than there: the two rates are independent of each other and of who is
    present."""
    max_insertions: Count = 16
    """Insertions per token step."""
    max_agents: AtLeastOne = 128
    """Agents at any one time; or as many as a scene has at the end of the history, if
    more."""
    seed: Seed = 0
    """Seed of all random streams."""
    recordings: Annotated[str, NOT_IN_KEY] = ""
    """Folder of drives that `infgen drive` saved: they are taken, and nothing is simulated.
    The other settings, but `split`, have no effect then."""

    @model_validator(mode="after")
    def _check(self) -> "RolloutSettings":
        mode = MODES[self.mode]
        for name in mode.fixed:
            given, fixed = getattr(self, name), getattr(mode, name)
            if given is not None and given != fixed:
                raise ValueError(
                    f"{name} is {given}, but mode={self.mode} has {fixed}; set it to that, "
                    "leave it out, or choose another mode"
                )
        if self.signals == "log" and self.mode == "wosac":
            raise ValueError(
                "signals=log shows the future, which mode=wosac forbids; set signals=now"
            )
        self._check_rules()
        CLOCK.tokens_in(self.duration_s)
        return self

    def _check_rules(self) -> None:
        """Refuse a rule where there are none, and rules that need another one."""
        for name in RULE_NAMES if self.rules == "none" else ():
            given = getattr(self, name)
            if given is not None and given != getattr(RULE_SETS["none"], name):
                raise ValueError(
                    f"{name} is {given}, but rules=none has no rules; set rules=safe, or "
                    f"leave {name} out"
                )
        rule_set = self.rule_set
        for name in ("reject_off_road", "max_stall_s"):
            if getattr(rule_set, name) and rule_set.max_motion_samples < 2:
                raise ValueError(
                    f"{name} is {getattr(rule_set, name)} and needs motion tokens that are "
                    f"sampled again, but max_motion_samples is "
                    f"{rule_set.max_motion_samples}; set max_motion_samples=32, or switch "
                    f"{name} off too"
                )

    def with_rules(self, rules: RuleName) -> "RolloutSettings":
        """Return them with all rules of a set, or unchanged if they are of that set.

        Raises:
            ValueError: if there is no such set.
        """
        if rules == self.rules:
            return self
        as_the_set_says: dict[str, Any] = dict.fromkeys(RULE_NAMES)
        return replace(self, rules=rules, **as_the_set_says)

    @property
    def rule_set(self) -> RuleSet:
        """The value of every rule."""
        given = {name: getattr(self, name) for name in RULE_NAMES}
        own = {name: value for name, value in given.items() if value is not None}
        return replace(RULE_SETS[self.rules], **own)

    @property
    def rules_in_words(self) -> str:
        """The set of rules and what differs from it, such as ``safe, max_stall_s=30``."""
        usual, rule_set = RULE_SETS[self.rules], self.rule_set
        changed = (
            f"{name}={_word(getattr(rule_set, name))}"
            for name in RULE_NAMES
            if getattr(rule_set, name) != getattr(usual, name)
        )
        return ", ".join([self.rules, *changed])

    @property
    def duration_s(self) -> float:
        """Seconds that are simulated."""
        return MODES[self.mode].seconds if self.seconds is None else self.seconds

    @property
    def simulates_all_agents(self) -> bool:
        """Whether agents are simulated however far they are from the ego."""
        return MODES[self.mode].all_agents if self.all_agents is None else self.all_agents

    @property
    def inserts(self) -> bool:
        """Whether agents are inserted."""
        return MODES[self.mode].insert if self.insert is None else self.insert

    @property
    def removes(self) -> bool:
        """Whether agents are removed."""
        return MODES[self.mode].remove if self.remove is None else self.remove


def _word(value: float | bool) -> str:
    """Write a value as ``-s`` on the command line takes it."""
    return str(value).lower() if isinstance(value, bool) else f"{value:g}"
