"""Counts the words of every source file. A file that says ``fail`` makes its unit fail, one
that says ``die`` ends its process, one that says ``hoard`` fills its memory, one that says
``hang`` never ends, and one that says ``assert`` (or, the first time only,
``assert-once``) fails as CUDA does on a failed device."""

import os
import time
from pathlib import Path

from pydantic.dataclasses import dataclass

from infgen.settings import RULES
from pipeline.engine.atomic import write_json
from pipeline.engine.stage import Stage, Unit


@dataclass(frozen=True, slots=True, config=RULES)
class CountSettings:
    longest: int = 100
    sleep_s: float = 0.0


def plan(inputs, settings):
    return [Unit(s.name, {"file": s.fingerprint}, {"url": s.url}) for s in inputs.sources]


def work(unit, target, settings, progress):
    words = Path(unit.task["url"]).read_text().split()
    if "die" in words:
        os._exit(1)
    if "assert" in words or ("assert-once" in words and _first(Path(unit.task["url"]))):
        import torch  # noqa: PLC0415

        raise torch.AcceleratorError("CUDA error: device-side assert triggered\nMore.")
    if "fail" in words:
        raise ValueError(f"{unit.name} says fail")
    if "hoard" in words:
        hoard = [bytearray(os.urandom(1) * (1 << 24)) for _ in range(64)]
        time.sleep(len(hoard))
    while "hang" in words:
        time.sleep(1)
    for part in range(3):
        time.sleep(settings.sleep_s / 3)
        (target / f"part-{part}.txt").write_text(" ".join(words[part::3]))
        progress(part + 1, 3)
    lengths = [len(word) for word in words if len(word) <= settings.longest]
    write_json(target / "count.json", {"words": len(lengths), "letters": sum(lengths)})
    return {"words": len(lengths), "run": {"letters_per_s": time.monotonic()}}


def _first(text):
    """Whether nobody has asked this for that text before."""
    try:
        text.with_suffix(".asked").touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def finish(inputs, units, target, settings, progress):
    words = {unit.name: unit.report["words"] for unit in units}
    write_json(target / "words.json", words)
    return {"words": sum(words.values()), "files": len(words)}


STAGE = Stage(
    name="count",
    version=1,
    settings={"count": CountSettings},
    plan=plan,
    work=work,
    finish=finish,
    modules=("toy_count",),
)
