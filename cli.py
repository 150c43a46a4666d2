"""The command line: words in, tables and exit codes out. ``pipeline`` does the work."""

import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from infgen import __version__
from infgen.errors import ConfigError
from pipeline.commands import tables, tools
from pipeline.commands.doctor import examine
from pipeline.commands.estimates import estimate_arms
from pipeline.commands.options import (
    WORK,
    ComparisonOptions,
    EstimateOptions,
    Json,
    RequestOptions,
    RootFolder,
    RunFlags,
    StrictCode,
    gathers,
)
from pipeline.commands.screen import show_table
from pipeline.commands.verbs import (
    FAILED,
    STALE,
    compare_arms,
    find_statuses,
    print_json,
    print_statuses,
    run_stages,
    tell_error,
    watch_stages,
)
from pipeline.engine import artefacts, signals
from pipeline.engine.garbage import find_garbage
from pipeline.engine.garbage import remove_garbage as remove_garbage
from pipeline.engine.layout import find_root
from pipeline.engine.manifest import verify as find_damage
from pipeline.settings import described
from pipeline.settings.request import OWN_FILE, find_file, named_weights
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from pipeline.stages.train import launch

ENVIRONMENT = {
    # One thread each: results then do not depend on the worker.
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    "CUBLAS_WORKSPACE_CONFIG": ":4096:8",  # Equal runs on a GPU give equal bits.
    "TORCH_NCCL_BLOCKING_WAIT": "1",  # A lost process is an error, not the end of all.
}
"""Variables that are set unless they are set already; some are read but once."""

FIRST_STEP = """\
To begin with: `infgen demo` runs every stage on built-in records, in minutes.

\b
Exit codes:
  0         done, or up to date
  1         a stage failed, or damage was found
  2         wrong words or settings
  3         something is stale (status --check), or too many records are quarantined
  75        another run is at it
  130, 143  stopped by SIGINT, by SIGTERM
"""

app = typer.Typer(
    name="infgen",
    help="Long-term traffic simulation: driving logs in, scored futures out.",
    epilog=FIRST_STEP,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Key = Annotated[str, typer.Argument(help="Start of a key, or the name of a stage.")]


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"infgen {__version__}")
        raise typer.Exit


@app.callback()
def infgen(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", is_eager=True, callback=_tell_version
        ),
    ] = False,
) -> None:
    """Long-term traffic simulation: driving logs in, scored futures out."""


@app.command()
@gathers(request_options=RequestOptions, comparing=ComparisonOptions, running=RunFlags)
def run(
    stages: Annotated[list[str] | None, typer.Argument(metavar="STAGE")] = None,
    json_: Json = False,
    *,
    request_options: RequestOptions,
    comparing: ComparisonOptions,
    running: RunFlags,
) -> None:
    """Make stages, and what they need, where they are not made yet (default: report).

    Example: infgen run report --root R --records '../data/*.tfrecord*' --profile small

    Example: infgen run report --preset towns-benchmark --arms infgen,smart,infgen-safe

    A preset trains, simulates and scores several methods alike and compares them.
    """
    if comparing.preset is not None:
        compare_arms(request_options, comparing, stages or [], running, as_json=json_)
        return
    run_stages(request_options.request(), stages or [], running, as_json=json_)


@app.command()
@gathers(request_options=RequestOptions, running=RunFlags)
def ingest(
    files: Annotated[list[str] | None, typer.Argument(metavar="RECORDS")] = None,
    json_: Json = False,
    *,
    request_options: RequestOptions,
    running: RunFlags,
) -> None:
    """Turn raw records into scenes.

    Example: infgen ingest '../data/*.tfrecord*' --root R --dask local:2

    Example: infgen ingest builtin --root R --profile small
    """
    run_stages(request_options.request(files or ()), ["ingest"], running, as_json=json_)


def _stage_verb(stage: str, what: str, *examples: str) -> None:
    @gathers(request_options=RequestOptions, running=RunFlags)
    def verb(
        json_: Json = False, *, request_options: RequestOptions, running: RunFlags
    ) -> None:
        run_stages(request_options.request(), [stage], running, as_json=json_)

    more = ("--profile small -n", "--profile small", *examples)
    lines = [f"Example: infgen {stage} --root R {words}" for words in more]
    before = (
        "Makes first what is missing before it, with the settings of --profile (without "
        "one: of the root's last run, or else the paper's, for GPUs); -n only says what."
    )
    app.command(stage, help="\n\n".join([what, *lines, before]))(verb)


_stage_verb("build-vocab", "Cluster the vocabularies of motion tokens and map tokens.")
_stage_verb("tokenize", "Write scenes as tokens.")
_stage_verb("train", "Train the network; goes on where a killed run stopped.")
_stage_verb(
    "calibrate",
    "Find the biases with which insertions and removals match the logs.",
    "--profile small -s calibrate.method=simulate --dask local:2",
)
_stage_verb(
    "rollout",
    "Simulate futures of the held-out scenes; settings are rollout.* of stages.yaml. "
    "rollout.rules=safe rejects choices that lead to collisions or off the road.",
    "--profile small --dask local:8 -s rollout.mode=wosac -s rollout.count=32",
    "--profile small -s rollout.rules=safe",
)
_stage_verb("reference", "Measure the logs of the scored split.")
_stage_verb("score", "Score the rollouts against the logs.")
_stage_verb("report", "Write tables and figures to one page.")


@app.command()
@gathers(
    request_options=RequestOptions, comparing=ComparisonOptions, estimating=EstimateOptions
)
def plan(
    json_: Json = False,
    strict_code: StrictCode = False,
    *,
    request_options: RequestOptions,
    comparing: ComparisonOptions,
    estimating: EstimateOptions,
) -> None:
    """Say what a run of all stages would make, and why (run -n).

    Example: infgen plan --root R -s tokenize.max_gap_s=2

    Example: infgen plan --root R --preset paper --dask local:8 --budget 24h

    Of a preset it says how long all arms will take, by a probe of a minute or two.
    """
    if comparing.preset is not None:
        estimate_arms(request_options, comparing, estimating, as_json=json_)
        return
    estimating.refuse_without_preset()
    found = find_statuses(request_options.request(), strict_code=strict_code)
    print_statuses(found, as_json=json_)


@app.command()
@gathers(request_options=RequestOptions)
def status(
    check: Annotated[bool, typer.Option("--check", help="Exit 3 if any is stale.")] = False,
    json_: Json = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Go on looking; with --check while it runs.")
    ] = False,
    every: Annotated[
        float, typer.Option(help="Seconds between two looks of --watch.", min=0.1)
    ] = 2.0,
    strict_code: StrictCode = False,
    *,
    request_options: RequestOptions,
) -> None:
    """Say how every stage stands to what is asked for, and why.

    Example: infgen status --root R -s tokenize.max_gap_s=2

    Example: infgen status --root R --watch
    """
    if watch:
        watch_stages(request_options, every, as_json=json_, check=check)
        return
    found = find_statuses(request_options.request(), strict_code=strict_code)
    print_statuses(found, as_json=json_)
    if check and any(standing.state != "cached" for standing in found):
        raise typer.Exit(STALE)


@app.command()
@gathers(request_options=RequestOptions)
def dag(
    mermaid: Annotated[bool, typer.Option("--mermaid", help="As a Mermaid chart.")] = False,
    *,
    request_options: RequestOptions,
) -> None:
    """Show which stage reads which.

    Example: infgen dag --mermaid
    """
    stages = request_options.request().stages(os.environ).stages
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
    place = find_root(root, made=True)
    garbage = (remove_garbage if yes else find_garbage)(place, named_weights(place))
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
    damage = list(find_damage(find_root(root, made=True), full=full))
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
    found = artefacts.find(find_root(root, made=True), key)
    print_json(artefacts.describe(found), spread=True)


@app.command()
def diff(one: Key, other: Key, root: RootFolder = WORK, json_: Json = False) -> None:
    """Say where two made stages or units differ.

    Example: infgen diff 3f2a91 77c0de --root R
    """
    place = find_root(root, made=True)
    folders = [artefacts.find(place, key) for key in (one, other)]
    found = list(artefacts.differences(*folders))
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
    found = target.absolute() == Path(OWN_FILE).absolute()
    used = "`infgen run` in this folder uses it"
    typer.echo(f"wrote {target}; {used if found else f'use it with --file {target}'}")


@app.command()
def settings(
    section: Annotated[
        str | None,
        typer.Argument(help="E.g. train, or train.steps; default: all."),
    ] = None,
    file: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of the stages.")
    ] = None,
    json_: Json = False,
) -> None:
    """List the settings there are: what -s and stages.yaml may name, and the defaults.

    Example: infgen settings train
    """
    stages = load_stages(find_file(file, {}), os.environ)
    found = described.find_sections(stages, section)
    if json_:
        print_json({"settings": [asdict(one) for each in found for one in each.settings]})
    else:
        tables.show_settings(found)


@app.command()
def doctor(root: RootFolder = WORK, json_: Json = False) -> None:
    """Check that this machine and disk can do what a run needs.

    Example: infgen doctor --root R
    """
    checks = list(examine(find_root(root)))
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
    run_stages(
        RequestOptions(root=root, profile="demo").request(), [], RunFlags(), as_json=json_
    )


app.add_typer(tools.app)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command; a known error is one line and an exit code."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    words = sys.argv[1:] if arguments is None else arguments
    code = 0
    try:
        launch.run(lambda: app(args=arguments), os.environ)
    except SystemExit as ended:  # As all commands end, with a number.
        code = int(ended.code or 0)
    except (ValueError, OSError, signals.Stopped) as error:
        code = tell_error(error, as_json="--json" in words)
    launch.leave(code, os.environ)


if __name__ == "__main__":
    main()
