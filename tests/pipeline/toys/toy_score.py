"""Stands for scoring: says what was played."""

from pydantic.dataclasses import dataclass

from infgen.settings import RULES
from pipeline.engine.layout import read_json
from pipeline.engine.stage import Stage


@dataclass(frozen=True, slots=True, config=RULES)
class ScoreSettings:
    presence_radius_m: float = 0.0


def plan(inputs, settings):
    return []


def work(unit, target, settings, progress):
    return {}


def finish(inputs, units, target, settings, progress):
    (target / "score.txt").write_text("scored")
    mode, weights = read_json(inputs.folder("rollout") / "played.json")
    return {"mode": mode, "weights": weights, "radius_m": settings.presence_radius_m}


STAGE = Stage(
    name="score",
    version=1,
    settings={"score": ScoreSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=("toy_score",),
)
