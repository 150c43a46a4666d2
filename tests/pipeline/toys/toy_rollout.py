"""Stands for playing: multiplies the weights."""

from pydantic.dataclasses import dataclass

from infgen.settings import RULES
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import read_json
from pipeline.engine.stage import Stage, Unit


@dataclass(frozen=True, slots=True, config=RULES)
class RolloutSettings:
    mode: str = "long"
    seed: int = 0
    fail: bool = False


def plan(inputs, settings):
    weights = {"weights": inputs.content("train", "weights.json")}
    return [Unit("played", weights, {})]


def work(unit, target, settings, progress):
    if settings.fail:
        raise ValueError("cannot play")
    return {}


def finish(inputs, units, target, settings, progress):
    weights = read_json(inputs.folder("train") / "weights.json")
    write_json(target / "played.json", [settings.mode, weights])
    return {"weights": weights}


STAGE = Stage(
    name="rollout",
    version=1,
    settings={"rollout": RolloutSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=("toy_rollout",),
)
