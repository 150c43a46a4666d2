"""Verbs that make no stage: building towns, scoring, exporting, watching; their options."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from infgen.errors import ConfigError
from pipeline.commands import tables
from pipeline.commands.options import (
    WORK,
    DriveOptions,
    Json,
    RequestOptions,
    RootFolder,
    gathers,
    split_names,
)
from pipeline.commands.screen import Screen
from pipeline.commands.verbs import FAILED, print_json
from pipeline.engine import signals
from pipeline.engine.events import Event
from pipeline.engine.layout import find_root

if TYPE_CHECKING:
    from pipeline.commands.export_job import Exported
    from pipeline.commands.view import Shown
    from pipeline.commands.wosac import Official
    from pipeline.storage.towns import Written

app = typer.Typer()


@dataclass(frozen=True, slots=True)
class WosacOptions:
    """What is scored by the official metric, and how."""

    records: Annotated[
        str, typer.Argument(help="TFRecords, several by comma, or an ingested folder.")
    ]
    rollouts: Annotated[
        Path, typer.Argument(help="A submission (binproto or tar.gz), or our rollouts.")
    ]
    metric: Annotated[
        str, typer.Option(help="wosac-2023, -2024, -2025 or -2025-scenario-gen.")
    ] = "wosac-2025"
    count: Annotated[
        int, typer.Option(help="Rollouts of each scene of a submission; 0 for any.")
    ] = 32
    per_scene: Annotated[bool, typer.Option("--per-scene", help="Each scene too.")] = False

    def official(self, tell: Callable[[Event], None]) -> "Official":
        """Score, with progress events."""
        from pipeline.commands.wosac import score_files  # noqa: PLC0415

        names = split_names(self.records)
        return score_files(names, self.rollouts, self.metric, self.count, tell)


@dataclass(frozen=True, slots=True)
class TownsOptions:
    """Which towns are built, and where to."""

    out: Annotated[Path, typer.Option(help="Folder to write to.")]
    scenes: Annotated[int, typer.Option(help="How many scenes.")] = 20
    seconds: Annotated[
        float, typer.Option(help="Length of each: 9.1 as WOMD's, or 31.1, or 311.")
    ] = 9.1
    seed: Annotated[int, typer.Option(help="Other towns for another seed.")] = 0
    split: Annotated[str, typer.Option(help="Start of the file names.")] = "training"
    scenes_per_file: Annotated[int, typer.Option(help="Most scenes of a file.")] = 20
    jobs: Annotated[int, typer.Option(help="Processes; 0: one per core.")] = 0
    variety: Annotated[
        str,
        typer.Option(
            help="basic, broad (they differ more), recovery or steady (docs/towns.md)."
        ),
    ] = "basic"
    scenes_per_town: Annotated[
        int, typer.Option(help="Scenes of each town; 0: ten (of broad ones five).")
    ] = 0

    def write(self, tell: Callable[[Event], None]) -> "Written":
        """Write their records, with progress events."""
        from pipeline.storage.towns import Order, write_towns  # noqa: PLC0415

        return write_towns(Order(**asdict(self)), tell)


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """What is exported, in whose format and to where."""

    to: Annotated[
        str, typer.Option("--to", help="wosac, gpudrive, scenarionet or parquet.")
    ]
    out: Annotated[Path, typer.Option(help="Folder to write; of wosac a .tar.gz.")]
    rollouts: Annotated[
        Path | None, typer.Argument(help="Our rollouts; default: the root's latest.")
    ] = None
    root: RootFolder = WORK
    records: Annotated[
        str | None,
        typer.Option(
            help="Their logs: TFRecords, or an ingested folder; default: a saved drive's "
            "own, or the root's."
        ),
    ] = None
    about: Annotated[
        Path | None, typer.Option(help="YAML file that describes the submission (wosac).")
    ] = None
    scenes_per_shard: Annotated[int, typer.Option(help="Of wosac.", min=1)] = 300

    def write(self, tell: Callable[[Event], None]) -> "Exported":
        """Export, with progress events."""
        from pipeline.commands.export import export  # noqa: PLC0415
        from pipeline.commands.export_job import Order  # noqa: PLC0415
        from pipeline.commands.export_wosac import read_description  # noqa: PLC0415
        from pipeline.storage.saved_rollouts import is_saved  # noqa: PLC0415
        from pipeline.storage.scene_lookup import open_scene_lookup  # noqa: PLC0415

        root = find_root(self.root)
        beside = self.rollouts is not None and is_saved(self.rollouts)
        logs = [str(self.rollouts if beside else root.latest / "ingest")]
        logs = split_names(self.records) if self.records else logs
        about = read_description(self.about, root) if self.about else None
        order = Order(
            to=self.to,
            rollouts=self.rollouts or root.latest / "rollout",
            logs=open_scene_lookup(logs),
            out=self.out,
            about=about,
            scenes_per_shard=self.scenes_per_shard,
        )
        return export(order, tell)


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """What is watched, and what is written of it."""

    source: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ROOT | RECORDS...]",
            help="A root, saved rollouts or drives, or TFRecords to see a log of.",
        ),
    ] = None
    root: RootFolder = WORK
    scene: Annotated[str, typer.Option(help="Start of its id; default: the first.")] = ""
    rollouts: Annotated[
        str | None, typer.Option(help="E.g. 0,1,2, or none; default: the first three.")
    ] = None
    log: Annotated[bool, typer.Option(help="Show the log beside the rollouts.")] = True
    out: Annotated[
        Path | None, typer.Option(help="Page to write; default: SCENE.html here.")
    ] = None
    video: Annotated[Path | None, typer.Option(help="MP4 or GIF to write.")] = None
    strip: Annotated[
        Path | None, typer.Option(help="SVG or PNG to write: moments side by side.")
    ] = None
    size: Annotated[str, typer.Option(help="Of the video.")] = "1920x1080"
    fps: Annotated[
        int | None, typer.Option(help="Of the video; default: 25, of a GIF 10.")
    ] = None
    every: Annotated[float, typer.Option(help="Seconds between moments of a strip.")] = 6.0
    theme: Annotated[str, typer.Option(help="light or dark: video and strip.")] = "light"

    def write(self, tell: Callable[[Event], None]) -> "Shown":
        """Write it, with progress events."""
        from pipeline.commands.view import Wanted, check_records, is_root, view  # noqa: PLC0415
        from pipeline.storage.saved_rollouts import is_saved  # noqa: PLC0415

        words = [part for word in self.source or () for part in split_names(word)]
        only = Path(words[0]) if len(words) == 1 else None
        root = only if only and is_root(only) else None
        saved = only if only and is_saved(only) else None
        for word in () if root or saved else words:
            check_records(word)
        width_px, height_px = _size(self.size)
        wanted = Wanted(
            root=find_root(root or self.root),
            saved=saved,
            records=() if root or saved else tuple(words),
            scene=self.scene,
            rollouts=_indices(self.rollouts),
            log=self.log,
            page=self.out,
            video=self.video,
            strip=self.strip,
            width_px=width_px,
            height_px=height_px,
            fps=self.fps,
            theme=self.theme,
            every_s=self.every,
        )
        return view(wanted, tell)


def _indices(word: str | None) -> tuple[int, ...] | None:
    """Read indices of rollouts: ``0,2``, or ``none``."""
    if word is None or word == "none":
        return None if word is None else ()
    try:
        return tuple(int(part) for part in word.split(","))
    except ValueError as error:
        raise ConfigError(f"--rollouts {word}: expected e.g. 0,1,2, or none") from error


def _size(word: str) -> tuple[int, int]:
    """Read a size of pictures: ``1280x720``."""
    try:
        width, height = word.lower().split("x")
        return int(width), int(height)
    except ValueError as error:
        raise ConfigError(f"--size {word}: expected e.g. 1280x720") from error


@app.command()
@gathers(building=TownsOptions)
def towns(json_: Json = False, *, building: TownsOptions) -> None:
    """Write synthetic driving logs as WOMD records (needs SUMO: the extra towns).

    Example: infgen towns --out towns --scenes 200 --seconds 31.1 --split validation

    A run that was killed goes on where it stopped, if the same is requested again.
    """
    with signals.handling_signals(), Screen() as screen:
        found = building.write(screen)
    if json_:
        print_json(found.to_json())
    else:
        tables.show_towns(found)


@app.command()
@gathers(scoring=WosacOptions)
def wosac(json_: Json = False, *, scoring: WosacOptions) -> None:
    """Score rollouts by the metric of the Waymo Open Sim Agents Challenge.

    Example: infgen wosac 'validation.tfrecord-*' submission.tar.gz --per-scene
    """
    with signals.handling_signals(), Screen() as screen:
        found = scoring.official(screen)
    if json_:
        print_json(found.to_json())
    else:
        tables.show_official(found, per_scene=scoring.per_scene)
    if found.refused:
        raise typer.Exit(FAILED)


@app.command()
@gathers(exporting=ExportOptions)
def export(json_: Json = False, *, exporting: ExportOptions) -> None:
    """Write rollouts in the format of others.

    Example: infgen export --to wosac --about about.yaml --out submission.tar.gz --root R

    Example: infgen export --to parquet --out table --root R

    A submission (wosac) needs a file --about with account_name, unique_method_name, authors
    and acknowledge_complies_with_closed_loop_requirement.
    """
    with signals.handling_signals(), Screen() as screen:
        found = exporting.write(screen)
    if json_:
        print_json(found.to_json())
    else:
        tables.show_exported(found)


@app.command()
@gathers(request_options=RequestOptions, driving=DriveOptions)
def drive(*, request_options: RequestOptions, driving: DriveOptions) -> None:
    """Drive the ego by hand on a local page; the network drives everyone else.

    Example: infgen drive

    Example: infgen drive 637f20 --root R --weights builtin --no-browser --port 8080

    Example: infgen drive -s rollout.rules=none

    Rules keep the others from colliding (rollout.rules=safe) unless -s says none.
    Prints the address of the page and goes on until Ctrl-C. Drives that are saved there can
    be read by `infgen view`, `infgen export`, and `infgen score` (rollout.recordings).
    """
    with signals.handling_signals():
        driving.serve(request_options, typer.echo, partial(typer.echo, err=True))


@app.command()
@gathers(viewing=ViewOptions)
def view(json_: Json = False, *, viewing: ViewOptions) -> None:
    """Write a player page of a scene: its rollouts and its log, side by side.

    Example: infgen view R --scene 637f20 --rollouts 0,1,2

    Example: infgen view validation.tfrecord-00000-of-00150

    Example: infgen view R --video scene.mp4 --strip scene.svg
    """
    with signals.handling_signals(), Screen() as screen:
        found = viewing.write(screen)
    if json_:
        print_json(found.to_json())
    else:
        typer.echo("\n".join(path for path, _ in found.files))
