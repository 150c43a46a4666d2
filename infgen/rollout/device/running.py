"""State of a batch while agents are inserted, on the device."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from infgen.model.attention.neighbour_attention import Shared
from infgen.model.neighbours import MapFeatures
from infgen.model.step_memory import Insertions

State = TypeVar("State")


@dataclass(slots=True)
class RunningInsertions:
    """A batch while agents are inserted; changes in place.

    Attributes:
        entries: The token step as the network sees it, and the rollouts that a pass is for.
        numbers: Uniform numbers of all turns and attempts.
        going: Whether a rollout goes on.
        turn: Agents it has inserted.
        attempt: Positions rejected in this turn ...
        tried: ... and their cells.
        most: Most agents that it may have.
        wanted: Number of agents wanted around its ego; None without density control.
        add_bias: Added to the logit of ADD, latent rates included if there are any.
        num_agents: Agents in it.
        num_others: Agents around its ego, which is not counted.
        soon: Poses one token step ahead; None without an insertion mask.
        log: What was inserted, by turn; row -1 where nothing was. The last turn is for
            what was not inserted.
    """

    entries: Insertions
    numbers: Float64[Tensor, "rollout turn purpose attempt"]
    going: Bool[Tensor, " rollout"]
    turn: Int64[Tensor, " rollout"]
    attempt: Int64[Tensor, " rollout"]
    tried: Bool[Tensor, "rollout cell"]
    most: Int64[Tensor, " rollout"]
    wanted: Float64[Tensor, " rollout"] | None
    add_bias: Float64[Tensor, " rollout"] | float
    num_agents: Int64[Tensor, " rollout"]
    num_others: Int64[Tensor, " rollout"]
    soon: Float32[Tensor, "rollout row 3"] | None
    log: Float32[Tensor, "rollout turn_ 8"]


def tensors_of(state: object, without: tuple[type, ...] = (MapFeatures,)) -> list[Tensor]:
    """Return the tensors of a state, in the order of its fields.

    Encoded maps are left out if nothing else is said: they last as long as the batch.
    """
    if isinstance(state, Tensor):
        return [state]
    if isinstance(state, Shared):
        return [state.values]
    if isinstance(state, without) or not is_dataclass(state):
        return []
    parts = (getattr(state, each.name) for each in fields(state))
    return [x for part in parts for x in tensors_of(part, without)]


def with_tensors(state: State, tensors: Iterator[Tensor]) -> State:
    """Return a state of other tensors; the next ones are taken. Inverse of ``tensors_of``.

    Unlike by ``map_tensors`` maps stay as they are, and what is made of tensors, as copies
    in other precisions, is made anew.
    """
    changed: Any = state
    if isinstance(state, Tensor):
        changed = next(tensors)
    elif isinstance(state, Shared):
        changed = Shared.of(next(tensors))
    elif is_dataclass(state) and not isinstance(state, MapFeatures | type):
        names = [each.name for each in fields(state)]
        changed = replace(
            state, **{name: with_tensors(getattr(state, name), tensors) for name in names}
        )
    return changed
