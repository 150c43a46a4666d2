"""What the network is trained for: one masked mean per kind of token (SPEC 5).

Control tokens (stay or leave, add or begin) carry no class weights: their probabilities are
to be sampled from, so they must be calibrated. Each is supervised once per decision.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from infgen.model.batching.batch import Agents, Batch
from infgen.model.batching.supervision import OF_ROLLOUTS, AgentMasks, following
from infgen.model.latent_rates import Rate, RateProcess
from infgen.model.logits import (
    DetailOutputs,
    InsertionOutputs,
    MapOutputs,
    MotionOutputs,
    Outputs,
)
from infgen.model.neighbours import grid_place
from infgen.model.relations import Rows, wrap_angle
from infgen.model.training.rate_likelihood import Decisions, rate_likelihood
from infgen.model.training_settings import TrainSettings
from infgen.tokens.scene_tokens import EGO, Presence


@dataclass(frozen=True, slots=True)
class Term:
    """One term of the loss, as sums, so that terms of several batches add up.

    Attributes:
        loss: Weighted sum over the supervised tokens.
        weight: Sum of their weights.
        count: How many there are.
        right: How many are predicted exactly; for control tokens the sum of the predicted
            probabilities of the event ...
        event: ... and how often it happened; 0 for others.
    """

    loss: Tensor
    weight: Tensor
    count: Tensor
    right: Tensor
    event: Tensor

    @property
    def mean(self) -> Tensor:
        """Mean loss; 0 where nothing is supervised."""
        return self.loss / self.weight.clamp(min=1e-6)

    def detach(self) -> "Term":
        """Drop the graph."""
        return Term(
            self.loss.detach(), self.weight, self.count, self.right.detach(), self.event
        )

    def __add__(self, other: "Term") -> "Term":
        return Term(
            self.loss + other.loss,
            self.weight + other.weight,
            self.count + other.count,
            self.right + other.right,
            self.event + other.event,
        )


Terms = dict[str, Term]
CONTROLS = ("keep", "add")
"""Terms of binary control tokens."""
MEASURED = (
    *("size", "offset", "position_regression", "heading_regression"),
    *OF_ROLLOUTS,
)
"""Terms of which nothing is right or wrong."""


def losses(
    outputs: Outputs,
    batch: Batch,
    settings: TrainSettings,
    masks: AgentMasks | None = None,
) -> Terms:
    """Compute every term, by name; none of what the network has no head for.

    Args:
        outputs: Of the network.
        batch: What they should have been.
        settings: Weights of first motion tokens, smoothing of labels, latent rates.
        masks: Those of the batch's agents, if they are known already.
    """
    smoothing, motion = settings.label_smoothing, outputs.motion
    masks = masks or AgentMasks.of(batch.agents)
    rates = _rates(outputs, settings)
    terms = {"motion": _motion(motion, batch.agents, settings, masks.motion)}
    if motion.remove_logit is not None:
        logit = motion.remove_logit
        terms["keep"] = _stay(motion.rows, logit, batch.agents, masks.stay, rates)
    if motion.pattern_logits is not None:
        logits = motion.pattern_logits
        terms["validity_pattern"] = _pattern(
            motion.rows, logits, batch.agents, masks.pattern
        )
    if outputs.entries is not None:
        terms |= _entries(outputs.entries, batch, smoothing, rates)
    if outputs.details is not None:
        terms |= _details(outputs.details, batch)
    if outputs.roads is not None:
        terms["map"] = _roads(outputs.roads, smoothing)
    return terms


def total(terms: Mapping[str, Term], settings: TrainSettings) -> Tensor:
    """Sum the terms' means, weighted as ``settings.loss_weight`` says."""
    weighted = [settings.loss_weight(name) * t.mean for name, t in terms.items()]
    return torch.stack(weighted).sum()


def figures(terms: Mapping[str, Term]) -> dict[str, float]:
    """Terms as numbers: loss and count, and accuracy, or for control tokens rates."""
    found: dict[str, float] = {}
    for name, term in terms.items():
        count = max(1.0, float(term.count))
        found[name] = float(term.mean.detach())
        found[f"{name}_count"] = float(term.count)
        if name in CONTROLS:
            found[f"{name}_predicted"] = float(term.right.detach()) / count
            found[f"{name}_logged"] = float(term.event) / count
        elif name not in MEASURED:
            found[f"{name}_accuracy"] = float(term.right.detach()) / count
    return found


def _motion(
    outputs: MotionOutputs, agents: Agents, settings: TrainSettings, mask: Tensor
) -> Term:
    """Next motion token of every agent; an inserted agent's first one counts more."""
    rows = outputs.rows
    mask = rows.pack(mask)
    weight = torch.ones(agents.motion_token.shape, device=mask.device)
    entering = agents.presence[:, 1:] == int(Presence.INSERTED)
    # At token 0 nobody comes in.
    weight[:, 1:].masked_fill_(entering, settings.first_motion_weight)
    target = rows.pack(following(agents.label, -1))
    chosen = Chosen.of(mask)
    return _choice(
        chosen,
        chosen.take(outputs.motion_logits),
        chosen.take(target),
        settings.label_smoothing,
        chosen.take(rows.pack(weight)),
    )


def _rates(outputs: Outputs, settings: TrainSettings) -> RateProcess | None:
    """Latent rates; what they are is learned where they are not scaled."""
    if outputs.rates is None or settings.latent_rate_scale == 1:
        return outputs.rates
    return outputs.rates.scaled(settings.latent_rate_scale).detached()


def _stay(
    rows: Rows,
    remove_logit: Tensor,
    agents: Agents,
    mask: Tensor,
    rates: RateProcess | None,
) -> Term:
    chosen = Chosen.of(rows.pack(mask))
    leaves = chosen.take(rows.pack(following(agents.removal, False)))
    term = _event(chosen, chosen.take(remove_logit), leaves)
    if rates is None:
        return term
    token_step = rows.at // agents.visible.shape[2]
    decisions = chosen.take(remove_logit), leaves, chosen.take(token_step)
    return _varying(term, chosen, decisions, Rate.REMOVAL, rates, agents)


def _pattern(rows: Rows, pattern_logits: Tensor, agents: Agents, mask: Tensor) -> Term:
    target = rows.pack(following(agents.pattern, 0))
    chosen = Chosen.of(rows.pack(mask))
    return _choice(chosen, chosen.take(pattern_logits), chosen.take(target), 0.0)


def _entries(
    outputs: InsertionOutputs, batch: Batch, smoothing: float, rates: RateProcess | None
) -> Terms:
    """Terms of ADD (BEGIN MOTION once after the last) and of the position tokens."""
    entries = batch.entries
    count = outputs.rows.pack(entries.count)[:, None]
    slot = torch.arange(entries.agent.shape[2], device=count.device)
    comes = outputs.rows.pack(entries.agent) >= 0
    decided, inserted = Chosen.of(slot <= count), Chosen.of(comes)
    happens = decided.take(outputs.rows.pack(entries.add))
    add_logit = decided.take(outputs.add_logit)
    terms = {"add": _event(decided, add_logit, happens)}
    if rates is not None:
        token_step = outputs.rows.at[:, None].expand(outputs.add_logit.shape)
        decisions = add_logit, happens, decided.take(token_step)
        terms["add"] = _varying(
            terms["add"], decided, decisions, Rate.INSERTION, rates, batch.agents
        )
    if outputs.position_logits is not None:
        cell = inserted.take(outputs.rows.pack(entries.cell))
        logits = inserted.take(outputs.position_logits)
        terms["position"] = _choice(inserted, logits, cell, smoothing)
    if outputs.position_m is not None:
        gap_m = inserted.take(outputs.position_m - _places(outputs.rows, batch))
        terms["position_regression"] = _distance(inserted, gap_m / outputs.radius_m)
    return terms


def _places(rows: Rows, batch: Batch) -> Tensor:
    """Positions of inserted agents in the ego's grid frame [row, slot, 2]."""
    pose = rows.pack(batch.agents.pose)  # [row, agent, 3]
    agent = rows.pack(batch.entries.agent).clamp(min=0)
    insertion_pose = pose.gather(1, agent[..., None].expand(-1, -1, 3))
    return grid_place(insertion_pose, pose[:, EGO, None])


def _details(outputs: DetailOutputs, batch: Batch) -> Terms:
    """Terms of agent type and size; heading and offset also of pseudo-insertions."""
    details, pack = batch.details, outputs.rows.pack
    real = Chosen.of(pack(details.inserted))
    size_log_m = pack(details.size_lwh_m).clamp(min=0.05).log()
    agent_type = real.take(pack(details.agent_type))
    terms = {
        "agent_type": _choice(real, real.take(outputs.agent_type_logits), agent_type, 0.0),
        "size": _distance(real, real.take(outputs.size_log_m - size_log_m)),
    }
    if outputs.heading_logits is not None:
        heading = pack(details.heading)
        terms["heading"] = _choice(ALL, outputs.heading_logits, heading, 0.0)
    if outputs.turned_rad is not None:
        gap_rad = wrap_angle(outputs.turned_rad - _turns(outputs.rows, batch))
        terms["heading_regression"] = _distance(ALL, gap_rad[:, None] / math.pi)
    if outputs.offset_m is not None:
        terms["offset"] = _distance(ALL, outputs.offset_m - pack(details.offset_m))
    if outputs.offset_logits is not None:
        offset = pack(details.offset)
        terms["offset_token"] = _choice(ALL, outputs.offset_logits, offset, 0.0)
    return terms


def _turns(rows: Rows, batch: Batch) -> Tensor:
    """Headings of the agents described, relative to the ego [row]."""
    details, heading_rad = batch.details, batch.agents.pose[..., 2]
    scene, token = rows.at // details.present.shape[1], rows.pack(details.token)
    own_rad = heading_rad[scene, token, rows.pack(details.agent)]
    return own_rad - heading_rad[scene, token, EGO]


def _roads(outputs: MapOutputs, smoothing: float) -> Term:
    return _choice(ALL, outputs.logits, outputs.token, smoothing)


@dataclass(frozen=True, slots=True)
class Chosen:
    """Which places of some arrays are supervised.

    A CPU takes them out. Elsewhere the host would wait to know how many there are: there
    all are kept, and ``counted`` says which of them count.

    Attributes:
        mask: The places that are taken out, if they are.
        counted: 1 for rows that count, else 0; None where all that are there do.
        dims: Dimensions of the mask.
    """

    mask: Tensor | None = None
    counted: Tensor | None = None
    dims: int = 1

    @classmethod
    def of(cls, mask: Tensor) -> "Chosen":
        """Choose the true places of a mask."""
        if mask.device.type == "cpu":
            return cls(mask)
        return cls(None, mask.flatten().float(), mask.dim())

    def take(self, values: Tensor) -> Tensor:
        """Rows of values whose first dimensions are the mask's."""
        if self.mask is not None:
            return values[self.mask]
        return values.flatten(0, self.dims - 1) if self.dims > 1 else values

    def sum(self, each: Tensor) -> Tensor:
        """Sum what counts of a number per row."""
        return each.sum() if self.counted is None else torch.dot(each.float(), self.counted)

    def count(self, each: Tensor) -> Tensor:
        """How many count."""
        if self.counted is None:
            return each.new_full((), float(len(each)))
        return self.counted.sum()


ALL = Chosen()
"""All rows."""


def _choice(
    chosen: Chosen,
    logits: Tensor,
    target: Tensor,
    smoothing: float,
    weight: Tensor | None = None,
) -> Term:
    """Cross-entropy of [row, choice] logits."""
    if chosen.counted is not None:
        target = target.clamp(min=0)  # Of rows that do not count.
    each = functional.cross_entropy(
        logits, target, reduction="none", label_smoothing=smoothing
    )
    right = chosen.sum(logits.argmax(dim=-1) == target) if len(logits) else each.sum()
    count = chosen.count(each)
    if weight is None:
        return Term(chosen.sum(each), count, count, right, _none(each))
    return Term(chosen.sum(each * weight), chosen.sum(weight), count, right, _none(each))


def _event(chosen: Chosen, logit: Tensor, happens: Tensor) -> Term:
    """Binary cross-entropy of [row] log-odds."""
    each = functional.binary_cross_entropy_with_logits(
        logit, happens.to(logit.dtype), reduction="none"
    )
    predicted, count = chosen.sum(torch.sigmoid(logit)), chosen.count(each)
    return Term(chosen.sum(each), count, count, predicted, chosen.sum(happens))


def _varying(
    term: Term,
    chosen: Chosen,
    decisions: tuple[Tensor, Tensor, Tensor],
    rate: Rate,
    rates: RateProcess,
    agents: Agents,
) -> Term:
    """Turn a term of independent events into that of events of a latent rate.

    Args:
        term: Of the same decisions.
        chosen: Which count.
        decisions: Log-odds, whether it happened, and token step of each.
        rate: What is decided.
        rates: Latent rates.
        agents: Those of the batch.
    """
    scenes, tokens = agents.visible.shape[:2]
    logit, happens, token_step = decisions
    told = Decisions(logit, happens.float(), token_step, chosen.counted)
    found = rate_likelihood(told, rate, rates, scenes, tokens)
    return replace(term, loss=found.loss, right=found.predicted)


def _distance(chosen: Chosen, gap: Tensor) -> Term:
    """Mean square of gaps [row, number]."""
    each, none = gap.square().mean(dim=-1), _none(gap)
    count = chosen.count(each)
    return Term(chosen.sum(each), count, count, none, none)


def _none(each: Tensor) -> Tensor:
    return each.new_zeros(())
