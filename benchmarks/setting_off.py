"""Does who stands first at a light set off when it turns green, and wait while it is red?

Logs, token step by token step as they are learned from, and what some weights expect::

    python benchmarks/setting_off.py ROOT [--weights ROOT/latest/train]
        [--split validation] [--scenes 80]

Vehicles count that have stood for a second with a stop line close ahead. The table has, by
what the line shows and whether anybody near is on the move, how many there were, the share
that set off in the next half second, and the share that was expected. The last line is one
JSON object.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32
from logged_scenes import asked, whole
from torch import Tensor
from traffic_drift import STILL_M

from infgen.model.batching.batch import Agents
from infgen.model.features.signals import CLASSES, LONG_SINCE, StopLines
from infgen.model.network import Network
from infgen.scene import AgentType
from infgen.tokens.scene_tokens import SceneTokens, SignalClass
from pipeline.commands.screen import show_table

CLOSE_M = 12.0
"""A stop line so far ahead of a vehicle's centre is its next one."""
NEAR_M = 15.0
"""Others within it are looked at."""
SHOWN = (
    "green since now",
    "green for 0.5 s",
    "green for 1 s",
    "green for 1.5 s",
    "green for longer",
    "yellow",
    "red",
    "several",
)


@dataclass(frozen=True, slots=True)
class Stood:
    """Vehicles that stood at a line in some half second.

    Attributes:
        shown: Which of ``SHOWN`` its line did.
        quiet: Whether nobody near was on the move.
        went: Whether it set off in the next half second ...
        expected: ... and how likely that was held to be.
    """

    shown: np.ndarray
    quiet: np.ndarray
    went: np.ndarray
    expected: np.ndarray


def look(network: Network, scene: SceneTokens) -> Stood:
    """Find who stood at a line in a log, and ask the network about each."""
    batch = whole(network, scene)
    shown = torch.from_numpy(scene.signal_state.astype(np.int64))[None]
    batch = replace(batch, roads=replace(batch.roads, shown=shown))  # Nobody looks away.
    with torch.no_grad():
        motion = network(batch).motion
    far_m = torch.from_numpy(network.motion_vocabulary().end_pose[..., :2]).norm(dim=-1)
    moves = (far_m > STILL_M)[batch.agents.agent_type[0]]  # [agent, move]
    logits = motion.rows.spread(motion.motion_logits)[0]  # [token, agent, move]
    odds = logits.softmax(dim=-1)
    stood, went, quiet = _who_stood(batch.agents)
    token, agent = stood.nonzero(as_tuple=True)
    lines = StopLines.of(batch.roads)
    pose = batch.agents.pose[0, token, agent]
    told = lines.ahead(pose, torch.zeros_like(token), token, CLOSE_M)
    shown, there = _shown(told.view(-1, CLASSES, 2 + LONG_SINCE))
    some = token[there], agent[there]
    return Stood(
        shown[there].numpy(),
        quiet[some].numpy(),
        went[some].numpy(),
        (odds * moves).sum(dim=-1)[some].numpy(),
    )


def _who_stood(agents: Agents) -> tuple[Bool[Tensor, "token agent"], ...]:
    """Who stood for a second, who set off then, and who had nobody on the move near it."""
    seen, pose = agents.observed[0], agents.pose[0]
    step_m = (pose[1:, :, :2] - pose[:-1, :, :2]).norm(dim=-1)  # [token - 1, agent]
    both = seen[1:] & seen[:-1]
    still, moved = both & (step_m < STILL_M), both & (step_m >= STILL_M)
    vehicle = agents.agent_type[0] == AgentType.VEHICLE
    stood = torch.zeros_like(seen)
    stood[2:-1] = still[1:-1] & still[:-2] & both[2:] & vehicle
    went = torch.zeros_like(seen)
    went[:-1] = moved
    moving = torch.zeros_like(seen)
    moving[1:] = moved
    away_m = (pose[:, :, None, :2] - pose[:, None, :, :2]).norm(dim=-1)
    quiet = ~((away_m < NEAR_M) & moving[:, None]).any(dim=-1)
    return stood, went, quiet


def _shown(
    told: Float32[Tensor, "row shown told"],
) -> tuple[Tensor, Bool[Tensor, " row"]]:
    """Which of ``SHOWN`` rows are told of, and whether they are told of any."""
    there, since = told[..., 0] > 0, told[..., 2:].sum(dim=-1)
    alone = there & (there.sum(dim=-1, keepdim=True) == 1)
    shown = torch.full((len(told),), SHOWN.index("several"))
    go = alone[:, SignalClass.GO]
    shown[go] = since[go, SignalClass.GO].long()
    shown[alone[:, SignalClass.CAUTION]] = SHOWN.index("yellow")
    shown[alone[:, SignalClass.STOP]] = SHOWN.index("red")
    return shown, there.any(dim=-1)


def report(found: Sequence[Stood]) -> list[dict[str, object]]:
    """Print the table; return its rows."""
    shown, quiet, went, expected = (
        np.concatenate([getattr(one, name) for one in found]) for name in Stood.__slots__
    )
    rows: list[dict[str, object]] = []
    for at, name in enumerate(SHOWN):
        for alone, others in ((True, "no other moves"), (False, "others move")):
            these = (shown == at) & (quiet == alone)
            if these.any():
                rows.append(
                    {
                        "shown": name,
                        "near": others,
                        "vehicles": int(these.sum()),
                        "set_off": round(float(went[these].mean()), 4),
                        "expected": round(float(expected[these].mean()), 4),
                    }
                )
    show_table(
        "who has stood for a second at a line, and sets off in the next half second",
        ("line shows", "near it", "vehicles x half seconds", "logs", "expected"),
        [
            (
                r["shown"],
                r["near"],
                r["vehicles"],
                f"{r['set_off']:.3f}",
                f"{r['expected']:.3f}",
            )
            for r in rows
        ],
    )
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Look at the logs of a root's tokens."""
    network, scenes = asked(__doc__, arguments)
    found = [look(network, scene) for scene in scenes]
    print(json.dumps({"scenes": len(found), "rows": report(found)}))


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
