"""The command line: words in, tables and exit codes out. The work is done in ``pipeline``.

Exit codes: 0 done or up to date; 1 a stage failed, or damage was found; 2 wrong words or
settings; 3 something is stale (``status --check``), or too many records were quarantined;
75 another run is at it; 130 and 143 stopped by SIGINT and SIGTERM.
"""

import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from infgen.config import ConfigError
from pipeline import lookup, ranks, stopping, tables
from pipeline.doctor import examine
from pipeline.folders import StoreError
from pipeline.locks import LockedError
from pipeline.manifest import verify as find_damage
from pipeline.options import (
    Asked,
    Building,
    Comparing,
    Exporting,
    Running,
    Scoring,
    Viewing,
    gathers,
)
from pipeline.plan import PlanError
from pipeline.root import Root
from pipeline.screen import Screen, show_table
from pipeline.settings import DEFAULT_FILE
from pipeline.sweep import find_garbage
from pipeline.sweep import sweep as remove_garbage
from pipeline.verbs import (
    FAILED,
    LOCKED,
    STALE,
    WRONG,
    compare_arms,
    find_standings,
    print_json,
    run_stages,
    show_plan,
    tell_standings,
    watch_stages,
)

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

app = typer.Typer(
    name="infgen",
    help="Long-term traffic simulation: driving logs in, scored futures out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Key = Annotated[str, typer.Argument(help="Start of a key, or the name of a stage.")]
RootFolder = Annotated[Path, typer.Option("--root", help="Folder of the experiment.")]
WORK = Path("work")


@app.command()
@gathers(asked=Asked, comparing=Comparing, running=Running)
def run(
    stages: Annotated[list[str] | None, typer.Argument(metavar="[STAGE]...")] = None,
    json_: Json = False,
    *,
    asked: Asked,
    comparing: Comparing,
    running: Running,
) -> None:
    """Make stages, and what they need, where they are not made yet (default: report).

    Example: infgen run report --root R --records '../data/*.tfrecord*' --profile small

    Example: infgen run report --root R --preset towns-benchmark --arms infgen,smart

    A preset trains, plays and scores several methods alike and sets them side by side.
    """
    if comparing.preset is not None:
        compare_arms(asked, comparing, stages or [], running, as_json=json_)
        return
    run_stages(asked.request(), stages or [], running, as_json=json_)


@app.command()
@gathers(asked=Asked, running=Running)
def ingest(
    files: Annotated[list[str] | None, typer.Argument(metavar="[RECORDS]...")] = None,
    json_: Json = False,
    *,
    asked: Asked,
    running: Running,
) -> None:
    """Turn raw records into scenes.

    Example: infgen ingest '../data/*.tfrecord*' --root R --dask local:2
    """
    run_stages(asked.request(files or ()), ["ingest"], running, as_json=json_)


def _stage_verb(stage: str, what: str, *examples: str) -> None:
    @gathers(asked=Asked, running=Running)
    def verb(json_: Json = False, *, asked: Asked, running: Running) -> None:
        run_stages(asked.request(), [stage], running, as_json=json_)

    lines = [f"Example: infgen {stage} --root R{more}" for more in ("", *examples)]
    app.command(stage, help="\n\n".join([what, *lines]))(verb)


_stage_verb("build-vocab", "Cluster the vocabularies of moves and road pieces.")
_stage_verb("tokenize", "Write scenes as tokens.")
_stage_verb("train", "Train the network; goes on where a killed run stopped.")
_stage_verb(
    "calibrate",
    "Find what rollouts add to their odds, so that as many come and go as in logs.",
    " -s calibrate.by=play --dask local:2",
)
_stage_verb(
    "rollout",
    "Play futures of the held-out scenes; settings are those of rollout.* in stages.yaml.",
    " --dask local:8 -s rollout.mode=wosac -s rollout.count=32",
)
_stage_verb("reference", "Count what the logs of the scored split do.")
_stage_verb("score", "Score the futures against the logs.")
_stage_verb("report", "Gather tables and figures in one page.")


@app.command()
@gathers(asked=Asked, running=Running)
def plan(json_: Json = False, *, asked: Asked, running: Running) -> None:
    """Say what a run would make, and why (run -n).

    Example: infgen plan --root R -s tokenize.max_gap_s=2
    """
    show_plan(asked.request(), [], running, as_json=json_)


@app.command()
@gathers(asked=Asked)
def status(
    check: Annotated[bool, typer.Option("--check", help="Exit 3 if any is stale.")] = False,
    json_: Json = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on looking; with --check while it runs.")
    ] = False,
    every: Annotated[
        float, typer.Option(help="Seconds between two looks of --watch.", min=0.1)
    ] = 2.0,
    strict_code: Annotated[bool, typer.Option(help="Other code makes stale.")] = False,
    *,
    asked: Asked,
) -> None:
    """Say how every stage stands to what is asked for, and why.

    Example: infgen status --root R -s tokenize.max_gap_s=2

    Example: infgen status --root R --watch
    """
    if watch:
        watch_stages(asked, every, as_json=json_, check=check)
        return
    found = find_standings(asked.request(), [], strict_code=strict_code)
    tell_standings(found, as_json=json_)
    if check and any(standing.state != "cached" for standing in found):
        raise typer.Exit(STALE)


@app.command()
@gathers(asked=Asked)
def dag(
    mermaid: Annotated[bool, typer.Option("--mermaid", help="As a Mermaid chart.")] = False,
    *,
    asked: Asked,
) -> None:
    """Show which stage reads which.

    Example: infgen dag --mermaid
    """
    stages = asked.request().stages(os.environ).stages
    typer.echo(tables.graph_text(stages.values(), mermaid=mermaid))


@app.command()
def gc(
    root: RootFolder = WORK,
    yes: Annotated[bool, typer.Option("--yes", help="Remove it.")] = False,
    json_: Json = False,
) -> None:
    """List what no profile's latest stages need; with --yes, remove it.

    Example: infgen gc --root R --yes
    """
    garbage = (remove_garbage if yes else find_garbage)(Root(root.absolute()))
    if json_:
        print_json({"removed": yes, "garbage": [asdict(each) for each in garbage]})
        return
    tables.show_garbage(garbage, removed=yes)


@app.command()
def verify(
    root: RootFolder = WORK,
    full: Annotated[
        bool, typer.Option("--full", help="Checksums, not only sizes.")
    ] = False,
    json_: Json = False,
) -> None:
    """Check every made file against its manifest.

    Example: infgen verify --root R --full
    """
    damage = list(find_damage(Root(root.absolute()), full=full))
    if json_:
        print_json({"damage": damage})
    else:
        typer.echo("\n".join(damage) if damage else "all files are as their manifests say")
    if damage:
        raise typer.Exit(FAILED)


@app.command()
def show(key: Key, root: RootFolder = WORK) -> None:
    """Print all that a made stage or unit says of itself.

    Example: infgen show tokenize --root R
    """
    print_json(lookup.describe(lookup.find(Root(root.absolute()), key)))


@app.command()
def diff(one: Key, other: Key, root: RootFolder = WORK, json_: Json = False) -> None:
    """Say where two made stages or units differ.

    Example: infgen diff 3f2a91 77c0de --root R
    """
    folders = [lookup.find(Root(root.absolute()), key) for key in (one, other)]
    found = list(lookup.differences(*folders))
    if json_:
        print_json({"differences": [list(each) for each in found]})
    else:
        show_table(f"{len(found)} differences", ("what", one, other), found)


@app.command()
def init(target: Annotated[Path, typer.Argument()] = Path("stages.yaml")) -> None:
    """Write a stages.yaml to change.

    Example: infgen init
    """
    if target.exists():
        raise ConfigError(f"{target} exists; move it away, or name another file")
    shutil.copyfile(DEFAULT_FILE, target)
    typer.echo(f"wrote {target}; `infgen run` in this folder uses it")


@app.command()
def doctor(root: RootFolder = WORK, json_: Json = False) -> None:
    """Check that this machine and disk can do what a run needs.

    Example: infgen doctor --root R
    """
    checks = list(examine(Root(root.absolute())))
    if json_:
        print_json({"checks": [asdict(check) for check in checks]})
    else:
        tables.show_checks(checks)
    if any(check.state == "bad" for check in checks):
        raise typer.Exit(FAILED)


@app.command()
def demo(root: RootFolder = WORK / "demo", json_: Json = False) -> None:
    """Run all stages on the built-in records, in minutes.

    Example: infgen demo
    """
    run_stages(Asked(root=root, profile="demo").request(), [], Running(), as_json=json_)


@app.command()
@gathers(building=Building)
def towns(json_: Json = False, *, building: Building) -> None:
    """Write synthetic driving logs as WOMD records (needs SUMO: the extra towns).

    Example: infgen towns --out towns --scenes 200 --seconds 31.1 --split validation

    A run that was killed goes on where it stopped, if the same is asked for again.
    """
    with stopping.listening(), Screen() as screen:
        found = building.write(screen)
    if json_:
        print_json(found.to_json())
    else:
        tables.show_towns(found)


@app.command()
@gathers(scoring=Scoring)
def wosac(json_: Json = False, *, scoring: Scoring) -> None:
    """Score rollouts by the metric of the Waymo Open Sim Agents Challenge.

    Example: infgen wosac 'validation.tfrecord-*' submission.tar.gz --per-scene
    """
    with stopping.listening(), Screen() as screen:
        found = scoring.official(screen)
    if json_:
        print_json(found.to_json())
    else:
        tables.show_official(found, per_scene=scoring.per_scene)
    if found.refused:
        raise typer.Exit(FAILED)


@app.command()
@gathers(exporting=Exporting)
def export(json_: Json = False, *, exporting: Exporting) -> None:
    """Write rollouts in the format of others.

    Example: infgen export --to wosac --about about.yaml --out submission.tar.gz --root R

    Example: infgen export --to parquet --out table --root R

    A submission (wosac) needs a file --about with account_name, unique_method_name, authors
    and acknowledge_complies_with_closed_loop_requirement.
    """
    with stopping.listening(), Screen() as screen:
        found = exporting.write(screen)
    if json_:
        print_json(found.to_json())
    else:
        tables.show_exported(found)


@app.command()
@gathers(viewing=Viewing)
def view(json_: Json = False, *, viewing: Viewing) -> None:
    """Write a page that plays a scene: its rollouts and its log, side by side.

    Example: infgen view R --scene 637f20 --rollouts 0,1,2

    Example: infgen view validation.tfrecord-00000-of-00150

    Example: infgen view R --video scene.mp4 --strip scene.svg
    """
    with stopping.listening(), Screen() as screen:
        found = viewing.write(screen)
    if json_:
        print_json(found.to_json())
    else:
        typer.echo("\n".join(path for path, _ in found.files))


def _exit_code(error: BaseException) -> int:
    """Exit code of a known error; an unknown one goes on as a traceback."""
    if isinstance(error, stopping.Stopped):
        return 128 + error.signal
    if isinstance(error, LockedError):
        return LOCKED
    if isinstance(error, ConfigError | PlanError):
        return WRONG
    if isinstance(error, StoreError | OSError):
        return FAILED
    ours = type(error).__module__.split(".")[0] in ("infgen", "pipeline")
    if isinstance(error, ValueError) and ours:
        return FAILED
    raise error


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; a known error is one line and an exit code."""
    for name in THREADS:  # One thread each: results then do not depend on who does a unit.
        os.environ.setdefault(name, "1")
    try:
        ranks.run(lambda: app(args=arguments), os.environ)
    except (ValueError, OSError, stopping.Stopped) as error:
        code = _exit_code(error)
        typer.echo(f"infgen: {error}", err=True)
        sys.exit(code)


if __name__ == "__main__":
    main()
