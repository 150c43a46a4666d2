"""Logits of one pass over a batch, as rows: nothing is computed for padding."""

from dataclasses import dataclass

from torch import Tensor

from infgen.model.latent_rates import RateProcess
from infgen.model.relations import Rows


@dataclass(frozen=True, slots=True)
class MotionOutputs:
    """What every visible agent does next.

    Attributes:
        rows: The visible agents among [scene, token, agent].
        motion_logits: [row, motion_token], by the vocabulary of the agent's kind.
        remove_logit: Log-odds that the next token is the agent's last [row].
        pattern_logits: When within the next token a log would show the agent [row, 32].
    """

    rows: Rows
    motion_logits: Tensor
    remove_logit: Tensor | None
    pattern_logits: Tensor | None


@dataclass(frozen=True, slots=True)
class InsertionOutputs:
    """Whether one more agent enters, and where.

    Attributes:
        rows: The tokens with a query among [scene, token].
        add_logit: Log-odds of ADD against BEGIN MOTION [row, slot].
        position_logits: [row, slot, cell] ...
        position_m: ... or the place itself, in the ego's grid frame [row, slot, 2].
        radius_m: Of that grid.
    """

    rows: Rows
    add_logit: Tensor
    position_logits: Tensor | None
    position_m: Tensor | None
    radius_m: float


@dataclass(frozen=True, slots=True)
class DetailOutputs:
    """Logits and values of an inserted agent at a cell.

    Attributes:
        rows: The agents described among [scene, detail].
        agent_type_logits: [row, agent_type].
        size_log_m: Logarithm of length, width, height, given the agent type [row, 3].
        heading_logits: Given the agent type [row, heading] ...
        turned_rad: ... or the heading itself, relative to the ego's [row].
        offset_m: From the cell's centre, in the ego's grid frame, given the agent type
            [row, 2]; None where places are regressed ...
        offset_logits: ... or bins of it, given the agent type [row, offset]; headings are
            then given the offset as well.
    """

    rows: Rows
    agent_type_logits: Tensor
    size_log_m: Tensor
    heading_logits: Tensor | None
    turned_rad: Tensor | None
    offset_m: Tensor | None
    offset_logits: Tensor | None = None


@dataclass(frozen=True, slots=True)
class MapOutputs:
    """Hidden map tokens: their logits [prediction, token] and what they are."""

    logits: Tensor
    token: Tensor


@dataclass(frozen=True, slots=True)
class Outputs:
    """All logits of a batch. What the network has no head for is None, here and above.

    Attributes:
        motion: What agents do next.
        entries: Whether and where inserted agents enter; None without a life cycle.
        details: Details of inserted agents; None for motion-only networks.
        roads: Hidden map tokens, if they were to be predicted.
        rates: Latent rates of insertion and removal; logits are those without.
    """

    motion: MotionOutputs
    entries: InsertionOutputs | None
    details: DetailOutputs | None
    roads: MapOutputs | None
    rates: RateProcess | None = None
