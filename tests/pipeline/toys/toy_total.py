"""Adds up the letters that ``count`` found, file by file."""

import json

from pydantic.dataclasses import dataclass

from infgen.settings import RULES
from pipeline.engine.atomic import write_json
from pipeline.engine.stage import Stage, Unit


@dataclass(frozen=True, slots=True, config=RULES)
class TotalSettings:
    times: float = 1.0
    refuse: bool = False


def plan(inputs, settings):
    return [
        Unit(done.name, {"count": done.key}, {"path": str(done.path)})
        for done in inputs.units("count")
    ]


def work(unit, target, settings, progress):
    with open(f"{unit.task['path']}/count.json") as file:
        letters = json.load(file)["letters"]
    write_json(target / "total.json", letters * settings.times)
    return {"total": letters * settings.times}


def finish(inputs, units, target, settings, progress):
    if settings.refuse:
        raise ValueError("told to refuse")
    total = sum(unit.report["total"] for unit in units)
    write_json(target / "total.json", total)
    return {"total": total}


STAGE = Stage(
    name="total",
    version=1,
    settings={"total": TotalSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=("toy_total",),
)
