"""Stands for training: its weights are a number; others go on from it. Some fail."""

from pathlib import Path
from typing import Annotated

from pydantic.dataclasses import dataclass

from infgen.errors import ConfigError
from infgen.settings import NOT_IN_KEY, RULES
from pipeline.engine.atomic import write_json
from pipeline.engine.layout import Root, read_json
from pipeline.engine.stage import Source, Stage, Unit


@dataclass(frozen=True, slots=True, config=RULES)
class TrainSettings:
    steps: int = 1
    seed: int = 0
    fail: bool = False
    initial_weights: Annotated[str, NOT_IN_KEY] = ""


def reads(root, settings):
    if not settings.initial_weights:
        return []
    path = Root(root).folder("train", settings.initial_weights) / "weights.json"
    if not path.is_file():
        raise ConfigError(
            f"train.initial_weights is {settings.initial_weights!r}; "
            "there are no such weights"
        )
    return [Source(str(path), "initial_weights", str(read_json(path)))]


def plan(inputs, settings):
    known = {source.name: source for source in inputs.sources}
    names = {name: source.fingerprint for name, source in known.items()}
    return [Unit("weights", names, {name: one.url for name, one in known.items()})]


def work(unit, target, settings, progress):
    if settings.fail:
        raise ValueError("told to fail")
    start = (
        read_json(Path(unit.task["initial_weights"]))
        if "initial_weights" in unit.task
        else 0
    )
    weights = start + settings.steps + 100 * settings.seed
    write_json(target / "weights.json", weights)
    return {"weights": str(weights)}


def finish(inputs, units, target, settings, progress):
    (unit,) = units
    write_json(target / "weights.json", int(unit.report["weights"]))
    return dict(unit.report)


STAGE = Stage(
    name="train",
    version=1,
    settings={"train": TrainSettings},
    plan=plan,
    work=work,
    finish=finish,
    reads=reads,
    modules=("toy_train",),
)
