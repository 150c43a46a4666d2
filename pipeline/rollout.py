"""Stage ``rollout``: weights and the first second of every scene to played futures.

One unit is some scenes of one shard with all their rollouts, so a task is long beside its
overhead. What a rollout does depends on its scene, its index and the seed alone.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import lru_cache
from itertools import accumulate, groupby, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infgen.clock import CLOCK
from infgen.config import RolloutSettings
from pipeline.calibration import Biases, read_biases
from pipeline.parquet import Fields, joined, table
from pipeline.splits import in_split
from pipeline.stage import Done, Inputs, Progress, Report, Stage, Unit

if TYPE_CHECKING:
    from infgen.rollout.player import Player
    from infgen.rollout.rollout import Rollout
    from infgen.rollout.trace import Start

SCHEMA = "infgen.rollouts/1"
TOGETHER_S = 1000.0
"""Seconds of rollouts that one group holds: 33 of 30 s, or one of ten minutes."""
INDEX: Fields = {
    "scenario_id": str,
    "rollout": int,
    "unit": str,
    "group": int,
    "row": int,
    "agents": int,
    "inserted": int,
    "left": int,
    "steps": int,
}


def plan(inputs: Inputs, settings: RolloutSettings) -> list[Unit]:
    """Cut each shard, or a part of it, into units of about equally many scenes."""
    weights = inputs.folder("train")
    identity = inputs.content("train", "model.safetensors", "model.json")
    biases = asdict(read_biases(weights) if settings.calibrate else Biases())
    shards = [
        done for done in inputs.units("ingest") if in_split(done.name, settings.split)
    ]
    counts = [int(done.report["scenes"]) for done in shards]
    units = []
    for done, scenes in zip(shards, _shares(counts, settings.scenes), strict=True):
        for first, after in pairwise(_edges(scenes, settings.scenes_per_task)):
            units.append(
                Unit(
                    name=f"{done.name}-{first:05d}",
                    inputs={"scenes": done.key, "weights": identity},
                    task={
                        "scenes": str(done.path),
                        "weights": str(weights),
                        "biases": biases,
                        "first": first,
                        "count": after - first,
                    },
                )
            )
    return units


def _shares(counts: Sequence[int], most: int) -> list[int]:
    """Scenes to take of each shard, of all alike; all of them if ``most`` is 0."""
    total = sum(counts)
    if most == 0 or most >= total:
        return list(counts)
    ends = [end * most // total for end in accumulate(counts, initial=0)]
    return [end - begin for begin, end in pairwise(ends)]


def _edges(scenes: int, most: int) -> list[int]:
    """Cut scenes into as few parts as may be: where each begins, and the end."""
    parts = math.ceil(scenes / most)
    return [math.ceil(scenes * at / parts) for at in range(parts)] + [scenes]


def play(unit: Unit, target: Path, settings: RolloutSettings, progress: Progress) -> Report:
    """Play all rollouts of some scenes, a batch at a time, and write them as groups."""
    from infgen.rollout.rollout import Rollout  # noqa: PLC0415
    from infgen.rollout.simulate import simulate  # noqa: PLC0415
    from infgen.rollout.trace import Frame, collect  # noqa: PLC0415
    from pipeline.store import write_records  # noqa: PLC0415

    biases = Biases(**unit.task["biases"])
    settings = replace(
        settings,
        add_bias=settings.add_bias + biases.add,
        leave_bias=settings.leave_bias + biases.leave,
    )
    folder, identity = Path(unit.task["weights"]), unit.inputs["weights"]
    player, weights = _player(folder, identity, settings)
    starts, refused = _starts(unit, player, settings)
    begun = time.monotonic()
    rows: list[dict[str, Any]] = []
    group = 0
    for batch in _batches(starts, settings.batch):
        frames: list[Frame] = []
        for frame in simulate(player, batch):
            frames.append(frame)
            share = len(frames) * CLOCK.token_s / settings.length_s
            played = len(rows) + len(batch) * share
            progress(played, len(starts), f"{_rate(played, begun):.3g} rollouts/s")
        few = max(1, int(TOGETHER_S / settings.length_s))
        for first in range(0, len(batch), few):
            places = range(len(batch))[first : first + few]
            rollouts = collect(batch, frames, weights, places)
            path = target / f"rollouts-{group:03d}.zarr"
            write_records(path, rollouts, Rollout, SCHEMA, compress=True)
            rows += [_row(unit.name, group, at, done) for at, done in enumerate(rollouts)]
            group += 1
    table(rows, INDEX).write_parquet(target / "index.parquet")
    pace = {"rollouts_per_s": round(_rate(len(rows), begun), 4)}
    told = {"add_bias": settings.add_bias, "leave_bias": settings.leave_bias}
    return {**_report(rows, refused), **told, "plays": player.plays, "run": pace}


def _rate(played: float | int, begun: float) -> float:
    return played / max(time.monotonic() - begun, 1e-9)


def read_rollouts(folder: Path) -> "Iterator[Rollout]":
    """Read the rollouts of one unit, a group in memory at a time."""
    from infgen.rollout.rollout import Rollout  # noqa: PLC0415
    from pipeline.store import read_records  # noqa: PLC0415

    for path in sorted(folder.glob("rollouts-*.zarr")):
        yield from read_records(path, Rollout, SCHEMA, mapped=False)


def finish(
    inputs: Inputs,
    units: Sequence[Done],
    target: Path,
    settings: RolloutSettings,
    progress: Progress,
) -> Report:
    """Write one index of all rollouts, and what they add up to."""
    index = joined([done.path for done in units], "index.parquet", INDEX)
    index.write_parquet(target / "index.parquet")
    count = sum(done.report["rollouts"] for done in units)
    totals = {
        name: sum(done.report[name] for done in units)
        for name in ("rollouts", "inserted", "left", "agents")
    }
    means = {
        f"{name}_per_rollout": totals[name] / count if count else 0.0
        for name in ("inserted", "left", "agents")
    }
    refused = [line for done in units for line in done.report["refused"]]
    plays = sorted({done.report["plays"] for done in units})
    biases = {name: units[0].report[name] for name in ("add_bias", "leave_bias") if units}
    return {
        "rollouts": count,
        "plays": "; ".join(plays),
        **means,
        **biases,
        "refused": refused,
    }


@lru_cache(maxsize=2)
def _player(
    weights: Path, identity: str, settings: RolloutSettings
) -> "tuple[Player, str]":
    """Load weights once per process: it may outlive what was at a path when it began."""
    import torch  # noqa: PLC0415

    from infgen.model.steps import Stepper  # noqa: PLC0415
    from infgen.rollout.player import Player  # noqa: PLC0415
    from pipeline.weights import load_network, read_about  # noqa: PLC0415

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network = load_network(weights).to(device).eval()
    player = Player(
        stepper=Stepper(network),
        codebook=network.motion_codebook(),
        roads=network.road_codebook(),
        tokens=network.grid_settings,
        settings=settings,
        device=device,
    )
    return player, str(read_about(weights)["weights"])


def _starts(
    unit: Unit, player: "Player", settings: RolloutSettings
) -> "tuple[list[Start], list[str]]":
    """Tokenize the histories; scenes that cannot be played are named with the reason."""
    from infgen.rollout.trace import Start  # noqa: PLC0415
    from infgen.tokens.tokenizer import read_lights, tokenize_scene  # noqa: PLC0415
    from pipeline.ingest import read_scenes  # noqa: PLC0415

    first, count = unit.task["first"], unit.task["count"]
    tokens = player.tokens
    if settings.plays_everyone:
        tokens = replace(tokens, max_distance_m=math.inf)
    starts, refused = [], []
    for scene in islice(read_scenes(Path(unit.task["scenes"])), first, first + count):
        try:
            history = tokenize_scene(
                scene, player.codebook, player.roads, tokens, until=scene.now
            )
        except ValueError as error:
            refused.append(f"{scene.scenario_id}: {error}")
            continue
        lights = read_lights(scene) if settings.lights == "log" else None
        starts += [
            Start(scene, history, at, settings.seed, lights) for at in range(settings.count)
        ]
    return starts, refused


def _batches(starts: "Sequence[Start]", size: int) -> "Iterator[list[Start]]":
    """Cut into batches whose histories are of one length."""
    for _, group in groupby(starts, key=lambda start: start.history.now):
        alike = list(group)
        yield from (alike[at : at + size] for at in range(0, len(alike), size))


def _row(unit: str, group: int, at: int, rollout: "Rollout") -> dict[str, Any]:
    return {
        "scenario_id": rollout.scenario_id,
        "rollout": rollout.index,
        "unit": unit,
        "group": group,
        "row": at,
        "agents": len(rollout.id),
        "inserted": int((~rollout.logged).sum()),
        "left": int((rollout.exit_step >= 0).sum()),
        "steps": rollout.num_steps,
    }


def _report(rows: list[dict[str, Any]], refused: list[str]) -> Report:
    totals = {
        name: sum(row[name] for row in rows) for name in ("agents", "inserted", "left")
    }
    return {"rollouts": len(rows), **totals, "refused": refused}


STAGE = Stage(
    name="rollout",
    version=4,
    settings={"rollout": RolloutSettings},
    plan=plan,
    work=play,
    finish=finish,
    modules=(
        "infgen.rollout",
        "infgen.model",
        "infgen.tokens",
        "pipeline.calibration",
        "pipeline.rollout",
    ),
)
