"""Settings of stage ``calibrate``: biases that make insertion and removal rates right."""

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from infgen.settings import RULES, AtLeastOne, Count, Float, NonNegative

Range = Annotated[Float, Field(gt=0)]


@dataclass(frozen=True, slots=True, config=RULES)
class CalibrateSettings:
    """How the biases on the log-odds of insertion and removal are found (SPEC 3.6)."""

    method: Literal["odds", "simulate", "none"] = "odds"
    """`odds` makes the predicted rates of insertion and removal on held-out logs equal to
    the logged ones, token step by token step, from the last validation of the weights. In a
    rollout the network meets its own choices, so counts may still be wrong. `simulate`
    starts from there, simulates some scenes with several pairs of biases, and takes those
    that bring as many insertions, removals and agents as the logs; where nothing may be
    inserted or removed it equals `odds`. `none` adds nothing."""
    split: str = "training"
    """Split whose scenes are simulated (start of the file name). Never that of the rollouts
    that are scored, but with logs as long and as much of a map."""
    max_scenes: Count = 48
    """Scenes to simulate, evenly spread over the split, each once per pair of biases; 0
    for all."""
    scenes_per_unit: AtLeastOne = 16
    """Scenes of one unit of work."""
    add_bias_range: Range = 0.8
    """Insertion biases up to this far above that of `odds` are simulated. The result may
    lie half as far again to either side."""
    remove_bias_range: Range = 0.3
    """The same for removal, above and below."""
    count_radius_m: NonNegative = 75.0
    """Agents within this distance of the ego are counted."""
