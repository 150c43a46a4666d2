"""The steps of ``benchmarks/census.py``, each run in a process of its own.

    python benchmarks/census_steps.py STEP FOLDER CENSUS [STAGE]

A step prints what it found as one line of JSON, if it finds anything.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

from census_root import Census, populate, write_records

from pipeline.engine.inputs import FinishedInputs
from pipeline.engine.layout import find_root
from pipeline.engine.plan import Plan
from pipeline.engine.tasks import make_tasks
from pipeline.engine.units import Task
from pipeline.settings.request import Request, complete_request

PROFILE = "tiny"
Found = dict[str, float]


def main() -> None:
    """Do one step."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("step", choices=STEPS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("census", type=json.loads, help="Fields of a Census.")
    parser.add_argument("stage", nargs="?", default="")
    asked = parser.parse_args()
    found = STEPS[asked.step](asked.folder, Census(**asked.census), asked.stage)
    print(json.dumps(found))


def write(folder: Path, census: Census, stage: str) -> Found:
    """Write the records."""
    from measuring import read_small_scene  # noqa: PLC0415

    write_records(folder / "records", census, read_small_scene())
    return {}


def fill(folder: Path, census: Census, stage: str) -> Found:
    """Make the units of a stage."""
    request, plan = _planned(folder, census, stage)
    found: Found = {"units": populate(request, plan, stage, census.scenes_per_unit)}
    request.remember(plan)
    return found


def split(folder: Path, census: Census, stage: str) -> Found:
    """Split the work of a stage into tasks, as a run does before the first of them."""
    request, plan = _planned(folder, census, stage)
    begun = time.perf_counter()
    tasks = _tasks(request, plan, stage)
    return {"units": len(tasks), "split_s": time.perf_counter() - begun}


def index(folder: Path, census: Census, stage: str) -> Found:
    """Open all tokens for training, order an epoch, and make the first batch."""
    from infgen.config import ModelSettings, TokenSettings, TrainSettings  # noqa: PLC0415
    from infgen.model.batching.batch import Limits  # noqa: PLC0415
    from pipeline.stages.train.loader import Recipe, TokenScenes  # noqa: PLC0415
    from pipeline.stages.train.sampler import ScenePermutation  # noqa: PLC0415

    request, plan = _planned(folder, census, "train")
    units = FinishedInputs(request.root, plan["train"]).units("tokenize")
    how, tokens = TrainSettings(), TokenSettings(insertion_distance_m=75)
    limits = Limits.of(ModelSettings(), how, tokens)
    marks = [time.perf_counter()]
    mark = partial(_mark, marks)
    shards = [done.path for done in units if done.name.startswith("training")]
    scenes = mark(lambda: TokenScenes(shards))
    sizes = mark(lambda: scenes.sizes(limits))
    order = ScenePermutation(sizes, 16, how.bucket_batches, seed=0)
    mark(lambda: order.scenes(0))
    mark(lambda: Recipe(scenes, limits, order)[0])
    names = ("index_s", "sizes_s", "sampler_s", "first_batch_s")
    spans = [after - before for before, after in pairwise(marks)]
    return {"scenes": len(scenes), **dict(zip(names, spans, strict=True))}


def _mark(marks: list[float], work: Callable[[], Any]) -> Any:
    found = work()
    marks.append(time.perf_counter())
    return found


def schedule(folder: Path, census: Census, stage: str) -> Found:
    """Send a task for each scene through Dask; its worker only reads a manifest."""
    from pipeline.workers.dask_cluster import LOOPBACK, DaskPool  # noqa: PLC0415
    from pipeline.workers.scheduling import PoolExecutor  # noqa: PLC0415

    request, plan = _planned(folder, census, stage)
    tasks, most, done = _tasks(request, plan, stage), 0, 0
    dask = import_module("distributed")
    task_bytes = len(import_module("distributed.protocol.pickle").dumps(tasks[-1]))
    cluster = dask.LocalCluster(
        2, threads_per_worker=1, host=LOOPBACK, dashboard_address=":0"
    )
    with cluster, dask.Client(cluster) as client:
        pool = DaskPool(client)
        begun = time.perf_counter()
        for _ in range(census.scenes_per_unit):  # The units are finished; any may be asked.
            for outcome in PoolExecutor(pool).run(
                tasks, _always, _say_nothing, _say_nothing
            ):
                if outcome.error:
                    raise RuntimeError(f"{outcome.name}: {outcome.error}")
                done, most = done + 1, max(most, len(cluster.scheduler.tasks))
        spent_s = time.perf_counter() - begun
        pool.close()
    return {
        "tasks": done,
        "ms_per_task": 1e3 * spent_s / done,
        "graph_size": most,
        "graph_bytes": most * task_bytes,
    }


def _always() -> bool:
    """Let every task begin."""
    return True


def _say_nothing(*about: object, **figures: object) -> None:
    """Report nothing."""


def _planned(folder: Path, census: Census, stage: str) -> tuple[Request, Plan]:
    request = complete_request(
        find_root(folder / "root"),
        file=None,
        profile=PROFILE,
        records=[str(folder / "records")],
        overrides=census.settings,
        environ={},
    )
    return request, request.plan([stage], {})


def _tasks(request: Request, plan: Plan, stage: str) -> list[Task]:
    planned = plan[stage]
    units = planned.stage.plan(FinishedInputs(request.root, planned), planned.settings)
    return make_tasks(request.root, planned, units)


STEPS: dict[str, Callable[[Path, Census, str], Found]] = {
    "write": write,
    "fill": fill,
    "split": split,
    "index": index,
    "schedule": schedule,
}

if __name__ == "__main__":
    main()
