"""From a batch as logged to what is learned of its rollouts, and what is noted of them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.network import Network
from infgen.model.training.policy_gradient.avoided.conflicts import find_conflicts
from infgen.model.training.policy_gradient.avoided.creeping import find_creeping
from infgen.model.training.policy_gradient.avoided.departures import find_departures
from infgen.model.training.policy_gradient.avoided.insertion_overlaps import (
    InsertionOverlaps,
    find_insertion_overlaps,
)
from infgen.model.training.policy_gradient.avoided.tokens import AvoidedTokens
from infgen.model.training.policy_gradient.policy_lesson import PolicyLesson
from infgen.model.training.policy_gradient.returns import (
    advantages,
    discounted_returns,
    of_insertions,
    of_rollouts,
)
from infgen.model.training.policy_gradient.rewards import Costs, find_costs
from infgen.model.training.policy_gradient.road import Road, read_roads
from infgen.model.training.policy_gradient.rollouts import (
    HISTORY_TOKENS,
    SimulatedRollouts,
    simulate_rollouts,
)
from infgen.model.training.simulation import REMOVED
from infgen.model.training_settings import TrainSettings
from infgen.tokens.vocabulary import MotionVocabulary

SUMS = (
    *("choices", "agents", "token_steps"),
    *("reward", "overlap", "off_road", "conflict", "energy_score", "compared"),
    *("overlapping_agents", "departing_agents", "present", "logged", "entries", "exits"),
    *("insertion_overlap", "departure", "creeping"),
)
"""Sums over the rollouts of a batch, in this order."""


@dataclass(frozen=True, slots=True)
class PolicyLessons:
    """What is learned of the rollouts of a batch.

    Attributes:
        lessons: One rollout of every scene each: so much is in memory at once.
        sums: ``SUMS`` over all of them.
    """

    lessons: list[PolicyLesson]
    sums: Float32[Tensor, " sum"]


def simulate_lessons(
    network: Network, batch: Batch, settings: TrainSettings, seed: int
) -> PolicyLessons:
    """Simulate rollouts of every scene, and weigh what the network chose in them.

    Args:
        network: The network; its mode (training or not) is kept.
        batch: Scenes as logged, without noise, on the network's device.
        settings: Number of rollouts, how they are sampled, and rewards.
        seed: Of everything that is sampled.
    """
    group, top_p = settings.policy_gradient_rollouts, settings.policy_top_p
    mask = settings.policy_insertion_mask
    scale = settings.latent_rate_scale
    rollouts = simulate_rollouts(network, batch, group, top_p, seed, mask, scale)
    roads = read_roads(batch.roads, network.map_vocabulary())
    vocabulary = network.motion_vocabulary()
    costs = find_costs(rollouts, vocabulary, roads)
    conflicts, departures, creeping = _find_avoided(rollouts, vocabulary, roads, settings)
    overlaps = InsertionOverlaps.none(network.grid, rollouts.moved.device)
    if settings.insertion_overlap_penalty:
        overlaps = find_insertion_overlaps(rollouts, network.grid)
    reward = costs.reward(settings)

    def grouped(values: Tensor) -> Tensor:
        return values.reshape(group, -1, *values.shape[1:])

    advantage = advantages(
        discounted_returns(grouped(reward), settings.policy_discount),
        *map(grouped, (rollouts.moved, rollouts.inserted, rollouts.known)),
    )
    type_reward = -settings.agent_type_penalty * costs.agent_type
    of_type = of_insertions(grouped(type_reward), grouped(rollouts.inserted))
    count_return = discounted_returns(
        grouped(-settings.count_penalty * costs.count), settings.policy_discount
    )
    goes_on = (rollouts.moved | rollouts.inserted).any(dim=2)
    of_count = of_rollouts(count_return, grouped(goes_on))
    lessons = [
        PolicyLesson(
            rollouts.only(number),
            rollouts.moved[rollouts.rows(number)],
            advantage[number],
            of_type[number],
            of_count[number],
            conflicts.only(rollouts.rows(number)),
            departures.only(rollouts.rows(number)),
            creeping.only(rollouts.rows(number)),
            overlaps.only(rollouts.rows(number)),
            rollouts.rate_log_odds[rollouts.rows(number)],
        )
        for number in range(group)
    ]
    taken = {
        "conflict": conflicts.taken,
        "departure": departures.taken,
        "creeping": creeping.taken,
        "insertion_overlap": overlaps.taken,
    }
    return PolicyLessons(lessons, _sums(rollouts, costs, taken, reward))


def _find_avoided(
    rollouts: SimulatedRollouts,
    vocabulary: MotionVocabulary,
    roads: list[Road],
    settings: TrainSettings,
) -> tuple[AvoidedTokens, AvoidedTokens, AvoidedTokens]:
    """Find motion tokens to be avoided: conflicts, departures, creeping."""
    none = AvoidedTokens.none(vocabulary, rollouts.moved.device)
    conflicts = departures = creeping = none
    if settings.conflict_penalty:
        conflicts = find_conflicts(rollouts, vocabulary)
    if settings.departure_penalty:
        departures = find_departures(rollouts, vocabulary, roads)
    if settings.creeping_penalty:
        creeping = find_creeping(rollouts, vocabulary)
    return conflicts, departures, creeping


def figures(sums: Tensor) -> dict[str, float]:
    """Means of the rollouts of a batch, by name, of its ``SUMS``."""
    found = dict(zip(SUMS, sums.tolist(), strict=True))
    choices, agents, steps, compared, entries = (
        max(1.0, found[name])
        for name in ("choices", "agents", "token_steps", "compared", "entries")
    )
    costs = ("reward", "overlap", "off_road", "conflict", "departure", "creeping")
    return {
        **{f"rollout_{name}": found[name] / choices for name in costs},
        "rollout_energy_score": found["energy_score"] / compared,
        "rollout_overlapping_agents": found["overlapping_agents"] / agents,
        "rollout_departing_agents": found["departing_agents"] / agents,
        "rollout_agents": found["present"] / steps,
        "rollout_agents_logged": found["logged"] / steps,
        "rollout_entries": found["entries"] / steps,
        "rollout_exits": found["exits"] / steps,
        "rollout_insertion_overlap": found["insertion_overlap"] / entries,
    }


def _sums(
    rollouts: SimulatedRollouts, costs: Costs, taken: dict[str, int], reward: Tensor
) -> Tensor:
    moved, inserted = rollouts.moved, rollouts.inserted
    agents, there = rollouts.batch.agents, moved | inserted
    logged = rollouts.logged.visible & there.any(dim=2, keepdim=True)
    logged[:, :HISTORY_TOKENS] = False
    found = {
        "choices": there,
        "agents": there.any(dim=1),
        "token_steps": there.any(dim=2),
        "reward": reward,
        "overlap": costs.overlap,
        "off_road": costs.off_road,
        **{name: torch.tensor(x, device=reward.device) for name, x in taken.items()},
        "energy_score": costs.energy_score,
        "compared": moved & rollouts.known[:, None] & rollouts.logged.observed,
        "overlapping_agents": costs.overlap.any(dim=1),
        "departing_agents": costs.off_road.any(dim=1),
        "present": there,
        "logged": logged,
        "entries": inserted,
        "exits": moved & (agents.presence == REMOVED),
    }
    return torch.stack([found[name].sum().float() for name in SUMS])
