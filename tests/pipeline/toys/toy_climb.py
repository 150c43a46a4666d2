"""Climbs step by step to the total, and goes on from where a killed try stood."""

import time
from pathlib import Path

from pydantic.dataclasses import dataclass

from infgen.settings import RULES
from pipeline.engine.atomic import write_file
from pipeline.engine.signals import Stopped
from pipeline.engine.stage import Stage, Unit


@dataclass(frozen=True, slots=True, config=RULES)
class ClimbSettings:
    steps: int = 5
    sleep_s: float = 0.0
    killed_at: int = -1


def plan(inputs, settings):
    return [Unit("climb", {"total": inputs.content("total", "total.json")}, {})]


def work(unit, target, settings, progress):
    state = target / "step.txt"
    begun = int(state.read_text()) if state.is_file() else 0
    with (target.parents[1] / "begun-at").open("a") as file:
        file.write(f"{begun}\n")
    step = begun
    try:
        for step in range(begun, settings.steps):
            progress(step, settings.steps, f"height {step}")
            time.sleep(settings.sleep_s)
            if step == settings.killed_at and begun == 0:
                raise RuntimeError("fell")
            write_file(state, str(step + 1).encode())
    except Stopped:
        write_file(state, str(step).encode())
        raise
    return {"height": settings.steps}


def finish(inputs, units, target, settings, progress):
    (Path(target) / "flag.txt").write_text("top\n")
    return {"height": units[0].report["height"]}


STAGE = Stage(
    name="climb",
    version=1,
    settings={"climb": ClimbSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=("toy_climb",),
    resumes=True,
    in_driver=True,
)
