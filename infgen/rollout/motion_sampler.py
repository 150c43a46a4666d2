"""Sampling of what every agent does next: motion tokens, removals, validity patterns."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from infgen.clock import CLOCK
from infgen.model.sampling import choose, sample_event
from infgen.model.token_step import MotionStep
from infgen.rollout.population import EGO_ROW, Population
from infgen.rollout.random_streams import Purpose, Streams
from infgen.rollout.rules.rejection import MotionCheck
from infgen.rollout.rules.stalls import StallRule
from infgen.rollout.simulator import Simulator
from infgen.tokens.scene_tokens import Presence


@dataclass(frozen=True, slots=True)
class Choices:
    """What was sampled for every agent; zeros in rows that nobody sees.

    Attributes:
        motion_token: Next motion token.
        remove: Whether it is the last one.
        pattern: Bits of the steps at which the agent is observed; None for all of them.
    """

    motion_token: Int64[np.ndarray, "rollout row"]
    remove: Bool[np.ndarray, "rollout row"]
    pattern: Int64[np.ndarray, "rollout row"] | None

    def observed_steps(
        self, before: Population, moved: Population
    ) -> Bool[np.ndarray, "rollout row 5"]:
        """Tell at which of the five steps each agent is observed.

        The ego is observed at all of them, an inserted agent at its first and a removed
        agent at its last, so that recorded entries and exits are exact.

        Args:
            before: All agents at the begin of the token step ...
            moved: ... and at its end.
        """
        steps = CLOCK.steps_per_token
        shown = np.ones((*moved.agent_number.shape, steps), dtype=bool)
        if self.pattern is None:
            return shown
        shown &= (self.pattern[..., None] >> np.arange(steps) & 1).astype(bool)
        shown[:, EGO_ROW] = True
        shown[..., 0] |= before.presence == Presence.INSERTED
        shown[..., -1] |= moved.presence == Presence.REMOVED
        return shown


@dataclass(frozen=True, slots=True)
class MotionSampler:
    """Samples what the agents of a batch of rollouts do next.

    Attributes:
        simulator: Settings, vocabulary and device.
        streams: Random numbers of the rollouts.
        check: Tells which motion tokens are rejected.
        stall_rule: Tells which vehicles have stalled; None if it is off.
        stationary: Motion tokens that stand still, by agent type.
    """

    simulator: Simulator
    streams: Streams
    check: MotionCheck
    stall_rule: StallRule | None
    stationary: Bool[Tensor, "3 motion_token"]

    def sample(
        self,
        before: Population,
        said: MotionStep,
        token: int,
        removal_rate: Float64[np.ndarray, " rollout"] | None = None,
    ) -> Choices:
        """Sample motion tokens, removals and patterns; the host waits once.

        Args:
            before: All agents.
            said: What the network expects of them.
            token: Token step that is sampled.
            removal_rate: Latent rates, added to the log-odds of removals; None without.
        """
        simulator, packed = self.simulator, said.packed
        visible, shape = before.visible, before.agent_number.shape
        agent_type = simulator.tensor(before.agent_type[visible].astype(np.int64))
        uniforms = self._uniforms(visible, token, Purpose.MOTION_TOKEN)
        drawn = [self._choose(packed.motion_logits, agent_type, uniforms)]
        settings = simulator.settings
        removes = packed.remove_logit is not None and settings.removes
        if packed.remove_logit is not None and removes:
            uniforms = self._uniforms(visible, token, Purpose.LEAVE)
            bias: Tensor | float = settings.remove_bias
            if removal_rate is not None:
                rollout, _ = visible.nonzero()
                bias = simulator.tensor(removal_rate[rollout] + settings.remove_bias)
            drawn.append(sample_event(packed.remove_logit, uniforms, bias))
        patterns = packed.pattern_logits is not None and settings.validity_patterns
        if packed.pattern_logits is not None and patterns:
            uniforms = self._uniforms(visible, token, Purpose.PATTERN)
            drawn.append(choose(packed.pattern_logits, uniforms))

        found = []
        for values in simulator.fetch(*drawn):
            spread = np.zeros(shape, dtype=values.dtype)
            spread[visible] = values
            found.append(spread)
        return Choices(
            motion_token=found[0],
            remove=found[1] if removes else np.zeros(shape, dtype=bool),
            pattern=found[-1] if patterns else None,
        )

    def release_stalled(
        self,
        before: Population,
        said: MotionStep,
        token: int,
        motion_token: Int64[np.ndarray, "rollout row"],
    ) -> Int64[np.ndarray, "rollout row"]:
        """Sample a moving token for vehicles that have stalled in a lane."""
        if self.stall_rule is None:
            return motion_token
        stalled = self.stall_rule.stalled(before, token - 1)
        stalled &= self.simulator.vocabulary.stationary[before.agent_type, motion_token]
        if not stalled.any():
            return motion_token
        # No other sample of this token step has this number.
        attempt = self.simulator.rules.max_motion_samples
        return self._resample(
            before, said, (token, attempt), motion_token, stalled, stalled
        )

    def reject(
        self,
        before: Population,
        said: MotionStep,
        token: int,
        motion_token: Int64[np.ndarray, "rollout row"],
        driven: Bool[np.ndarray, "rollout row"],
    ) -> Int64[np.ndarray, "rollout row"]:
        """Sample motion tokens again that lead to a collision or off the road.

        Args:
            before: All agents at the beginning of the token step.
            said: Logits of the network.
            token: Index of the token step.
            motion_token: Motion tokens so far.
            driven: Rows that are never sampled again.
        """
        tries, again = self.simulator.rules.max_motion_samples, ~driven
        check, slowest, changed = self.check, motion_token.copy(), again
        for attempt in range(1, tries):
            # Where no token satisfies both checks, only collisions are checked.
            road = attempt <= tries // 2
            hits, departs = check.rejects(before, motion_token, changed, road=road)
            again, steers = (hits | departs) & ~driven, departs & ~hits
            slower = check.is_slower(before, motion_token, slowest)
            slowest = np.where(slower & steers, motion_token, slowest)
            changed = again  # Rows with another token than before, braking ones included.
            if attempt == tries // 2:
                # A vehicle too fast for all of its samples takes the slowest one.
                brakes = steers & again & check.is_fast(before, motion_token)
                motion_token = np.where(brakes, slowest, motion_token)
                again = again & ~brakes
            if not again.any():
                break
            motion_token = self._resample(
                before, said, (token, attempt), motion_token, again, steers
            )
        return motion_token

    def _resample(
        self,
        before: Population,
        said: MotionStep,
        draw: tuple[int, int],
        motion_token: Int64[np.ndarray, "rollout row"],
        again: Bool[np.ndarray, "rollout row"],
        steers: Bool[np.ndarray, "rollout row"],
    ) -> Int64[np.ndarray, "rollout row"]:
        """Sample the motion tokens of some rows again.

        Args:
            before: All agents at the beginning of the token step.
            said: Logits of the network.
            draw: Index of the token step, and number of the sample.
            motion_token: Motion tokens so far.
            again: Rows to sample again.
            steers: Rows that must not take a token that stands still.
        """
        simulator, (token, attempt) = self.simulator, draw
        chosen = again & before.visible
        which = simulator.tensor(np.flatnonzero(again[before.visible]))
        uniforms = self._uniforms(chosen, token, Purpose.MOTION_TOKEN, attempt)
        agent_type = simulator.tensor(before.agent_type[chosen].astype(np.int64))
        stops = simulator.tensor(steers[chosen])[:, None] & self.stationary[agent_type]
        logits = said.packed.motion_logits[which].masked_fill(stops, -torch.inf)
        drawn = self._choose(logits, agent_type, uniforms)
        found = motion_token.copy()
        found[chosen] = simulator.fetch(drawn)[0]
        return found

    def _choose(self, logits: Tensor, agent_type: Tensor, uniforms: Tensor) -> Tensor:
        """Sample motion tokens; tokens that stand still have a nucleus of their own.

        A vehicle that seldom sets off then still does.
        """
        settings = self.simulator.settings
        return choose(
            logits,
            uniforms,
            settings.motion_top_k,
            nucleus=settings.motion_top_p,
            temperature=settings.motion_temperature,
            apart=self.stationary[agent_type] if settings.motion_top_p < 1 else None,
        )

    def _uniforms(
        self,
        chosen: Bool[np.ndarray, "rollout row"],
        token: int,
        purpose: Purpose,
        attempt: int = 0,
    ) -> Tensor:
        """Draw a uniform number per chosen row; it does not depend on the other rows."""
        # Rows beyond the last chosen one need none.
        rows = int(np.flatnonzero(chosen.any(axis=0)).max(initial=-1)) + 1
        numbers = self.streams.uniform(token, purpose, rows, attempt)
        return self.simulator.tensor(numbers[chosen[:, :rows]])
