"""What the network is trained for: one masked mean per kind of token (SPEC 5).

Control tokens (stay or leave, add or begin) carry no class weights: their probabilities are
to be sampled from, so they must be calibrated. Each is supervised once per decision.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from infgen.config import TrainSettings
from infgen.model.batch import Agents, Batch, Details, Entries
from infgen.model.network import EGO
from infgen.model.outputs import (
    DetailOutputs,
    EntryOutputs,
    MotionOutputs,
    Outputs,
    RoadOutputs,
)
from infgen.tokens.scene_tokens import Presence


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
CONTROLS = ("stay", "add")
"""Terms whose token is a yes or no."""


def losses(outputs: Outputs, batch: Batch, settings: TrainSettings) -> Terms:
    """Compute every term, by name."""
    smoothing = settings.label_smoothing
    terms = {
        "motion": _motion(outputs.motion, batch.agents, settings),
        "stay": _stay(outputs.motion, batch.agents),
        **_entries(outputs.entries, batch.entries, smoothing),
        **_details(outputs.details, batch.details),
    }
    if outputs.roads is not None:
        terms["map"] = _roads(outputs.roads, smoothing)
    return terms


def total(terms: Mapping[str, Term], settings: TrainSettings) -> Tensor:
    """Sum the terms' means, weighted as ``<name>_weight`` says."""
    weighted = [getattr(settings, f"{name}_weight") * t.mean for name, t in terms.items()]
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
        elif name not in ("size", "offset"):
            found[f"{name}_accuracy"] = float(term.right.detach()) / count
    return found


def motion_mask(agents: Agents) -> Tensor:
    """Tell which tokens [scene, token, agent] have a supervised next move (SPEC 3.5).

    The next move must be known. A newcomer's first one is always supervised. Later ones ask
    for the token before and the one itself to be observed, so that nothing is learned at
    the edges of a gap; entering counts as observed for the token that follows it.
    """
    entering = agents.presence == Presence.ENTERING
    there = agents.observed
    known = _next(agents.move, -1) >= 0
    mask = known & _next(there, False)
    mask &= entering | (there & _before(there | entering))
    return mask & agents.near[:, None]


def stay_mask(agents: Agents) -> Tensor:
    """Tell which tokens [scene, token, agent] decide between staying and leaving.

    All from entering to the last but one at which the agent is seen. Not the ego: it never
    leaves.
    """
    following = _next(agents.presence, int(Presence.ABSENT))
    goes_on = (following == Presence.PRESENT) | (following == Presence.LEAVING)
    here = agents.visible & (agents.presence != Presence.LEAVING)
    mask = here & goes_on
    mask[:, :, EGO] = False
    return mask


def _next(values: Tensor, last: int | bool) -> Tensor:
    """Shift values by one token, so that each stands where it is predicted from."""
    return torch.cat([values[:, 1:], torch.full_like(values[:, :1], last)], dim=1)


def _before(values: Tensor) -> Tensor:
    return torch.cat([torch.zeros_like(values[:, :1]), values[:, :-1]], dim=1)


def _motion(outputs: MotionOutputs, agents: Agents, settings: TrainSettings) -> Term:
    """Next move of every agent; a newcomer's first one counts more."""
    rows = outputs.rows
    mask = rows.pack(motion_mask(agents))
    weight = torch.ones(agents.move.shape, device=mask.device)
    entering = agents.presence[:, 1:] == Presence.ENTERING
    weight[:, 1:][entering] = settings.first_move_weight  # At token 0 nobody comes in.
    target = rows.pack(_next(agents.move, -1))
    return _choice(
        outputs.move_logits[mask],
        target[mask],
        settings.label_smoothing,
        rows.pack(weight)[mask],
    )


def _stay(outputs: MotionOutputs, agents: Agents) -> Term:
    mask = outputs.rows.pack(stay_mask(agents))
    following = outputs.rows.pack(_next(agents.presence, int(Presence.ABSENT)))
    return _event(outputs.leave_logit[mask], following[mask] == Presence.LEAVING)


def _entries(outputs: EntryOutputs, entries: Entries, smoothing: float) -> Terms:
    """ADD for every newcomer and BEGIN MOTION once after them; cells of newcomers."""
    count = outputs.rows.pack(entries.count)[:, None]
    slot = torch.arange(entries.agent.shape[2], device=count.device)
    decided = slot <= count
    comes = outputs.rows.pack(entries.agent) >= 0
    cell = outputs.rows.pack(entries.cell)
    return {
        "add": _event(outputs.add_logit[decided], comes[decided]),
        "cell": _choice(outputs.cell_logits[comes], cell[comes], smoothing),
    }


def _details(outputs: DetailOutputs, details: Details) -> Terms:
    """Kind and size of newcomers; heading and offset also of those who play the part."""
    pack = outputs.rows.pack
    real = pack(details.newcomer)
    size_log_m = pack(details.size_lwh_m).clamp(min=0.05).log()
    return {
        "kind": _choice(outputs.kind_logits[real], pack(details.kind)[real], 0.0),
        "size": _distance(outputs.size_log_m[real], size_log_m[real]),
        "heading": _choice(outputs.heading_logits, pack(details.heading), 0.0),
        "offset": _distance(outputs.offset_m, pack(details.offset_m)),
    }


def _roads(outputs: RoadOutputs, smoothing: float) -> Term:
    return _choice(outputs.logits, outputs.token, smoothing)


def _choice(
    logits: Tensor, target: Tensor, smoothing: float, weight: Tensor | None = None
) -> Term:
    """Cross-entropy of [row, choice] logits."""
    each = functional.cross_entropy(
        logits, target, reduction="none", label_smoothing=smoothing
    )
    weight = torch.ones_like(each) if weight is None else weight
    right = (logits.argmax(dim=-1) == target).sum() if len(logits) else each.sum()
    return Term((each * weight).sum(), weight.sum(), _count(each), right, _none(each))


def _event(logit: Tensor, happens: Tensor) -> Term:
    """Binary cross-entropy of [row] log-odds."""
    each = functional.binary_cross_entropy_with_logits(
        logit, happens.to(logit.dtype), reduction="none"
    )
    predicted = torch.sigmoid(logit).sum()
    return Term(each.sum(), _count(each), _count(each), predicted, happens.sum())


def _distance(found: Tensor, wanted: Tensor) -> Term:
    """Mean squared error of [row, number]."""
    each = (found - wanted).square().mean(dim=-1)
    return Term(each.sum(), _count(each), _count(each), _none(each), _none(each))


def _count(each: Tensor) -> Tensor:
    return each.new_tensor(float(len(each)))


def _none(each: Tensor) -> Tensor:
    return each.new_zeros(())
