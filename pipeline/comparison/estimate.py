"""What the runs of a comparison will take: core-hours, bytes and files, stage by stage.

Costs of one item come from a measured probe (``pipeline.comparison.probe``), numbers of
items from the settings and from the records (``pipeline.comparison.workload``). Everything
beyond the probe's few scenes, steps and seconds is extrapolated, in proportion.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from infgen.clock import CLOCK
from pipeline.comparison.costs import Cost
from pipeline.comparison.probe import kind
from pipeline.comparison.runs import ROLLOUT, SCORE, TRAIN
from pipeline.comparison.workload import CHECKPOINTS, ITEMS, VALIDATION, Work

S_PER_HOUR = 3600.0
CALIBRATE = "calibrate"
TRAINING = (TRAIN, VALIDATION, CHECKPOINTS)
"""What one process does."""


@dataclass(frozen=True, slots=True)
class Estimated:
    """One stage of one run.

    Attributes:
        stage: Its name.
        run: What makes it, in words.
        amount: How many items ...
        items: ... and of what.
        hours: Of a core, or of a GPU.
        bytes: On disk.
        files: On disk.
    """

    stage: str
    run: str
    amount: int
    items: str
    hours: float
    bytes: float
    files: int

    @property
    def is_scaled(self) -> bool:
        """Whether a budget cuts it: the steps, and the scenes that are simulated."""
        return self.stage in (*TRAINING, ROLLOUT, SCORE)


def estimate(work: Iterable[Work], costs: Mapping[str, Cost]) -> list[Estimated]:
    """Estimate all work."""
    return [_estimated(each, costs) for each in work]


def _estimated(work: Work, costs: Mapping[str, Cost]) -> Estimated:
    stage = ROLLOUT if work.stage == CALIBRATE else work.stage
    cost = costs[kind(work.arm_run, stage)]
    tokens = CLOCK.tokens_in(work.seconds) if work.seconds else 0
    each_s = cost.seconds + cost.per_token * tokens
    each_bytes = cost.bytes + cost.bytes_per_s * work.seconds
    seconds = work.amount * each_s + work.units * cost.per_unit
    kept = work.stage != CALIBRATE  # Its rollouts are only counted.
    return Estimated(
        stage=work.stage,
        run=work.arm_run.words if work.stage in (*TRAINING, ROLLOUT, SCORE) else "",
        amount=work.amount,
        items=ITEMS[work.stage],
        hours=seconds / S_PER_HOUR,
        bytes=work.amount * each_bytes if kept else 0.0,
        files=round(work.units * cost.files),
    )


@dataclass(frozen=True, slots=True)
class Budget:
    """What fits into a time.

    Attributes:
        share: Of the steps, and of the scenes that are simulated.
        steps: Of training.
        scenes: That are simulated.
        wider: How many times wider the intervals of scores get.
    """

    share: float
    steps: int
    scenes: int
    wider: float

    @property
    def words(self) -> list[str]:
        """Settings for the command line, over those of every arm."""
        return [f"train.steps={self.steps}", f"rollout.max_scenes={self.scenes}"]


def clock_hours(found: Iterable[Estimated], workers: int) -> float:
    """Hours by the clock: units run on all workers at once, training on one process."""
    hours = (one.hours / (1 if one.stage in TRAINING else workers) for one in found)
    return sum(hours, 0.0)


def fit(
    found: Sequence[Estimated], hours: float, workers: int, steps: int, scenes: int
) -> Budget | None:
    """Choose a share of steps and of simulated scenes that fits.

    Intervals come from drawing scenes again, so their width goes with one over the root of
    the number of scenes.

    Args:
        found: The whole work, with the same steps and scenes in all arms.
        hours: That there are, by the clock.
        workers: That do units at once.
        steps: Of training.
        scenes: That are simulated.

    Returns:
        The choice; None where nothing is left once the records are read.

    Examples:
        >>> train = Estimated("train", "infgen", 100, "scenes shown", 20.0, 0.0, 1)
        >>> ingest = Estimated("ingest", "", 100, "scenes", 5.0, 0.0, 1)
        >>> fit([train, ingest], hours=10.0, workers=1, steps=400, scenes=64)
        Budget(share=0.25, steps=100, scenes=16, wider=2.0)
    """
    scaled = clock_hours((each for each in found if each.is_scaled), workers)
    fixed = clock_hours((each for each in found if not each.is_scaled), workers)
    share = min(1.0, (hours - fixed) / scaled) if scaled else 1.0
    if share <= 0:
        return None
    played = max(1, int(share * scenes))
    return Budget(share, max(1, int(share * steps)), played, (scenes / played) ** 0.5)
