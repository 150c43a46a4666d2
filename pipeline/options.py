"""Options that several verbs share, gathered in records, and verbs that take them."""

import inspect
import os
from collections.abc import Callable, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from infgen.config import ConfigError
from pipeline.events import Event
from pipeline.plan import Plan, PlanError
from pipeline.preset_legs import PRESET, REPORT, Comparison
from pipeline.request import Request, complete, find_file, recall
from pipeline.root import Root
from pipeline.runner import Orders
from pipeline.settings import load_stages
from pipeline.sources import absolute

if TYPE_CHECKING:
    from pipeline.export import Exported
    from pipeline.towns import Written
    from pipeline.view import Shown
    from pipeline.wosac import Official


@dataclass(frozen=True, slots=True)
class Asked:
    """What names a request; what is not named is as in the root's last run."""

    root: Annotated[Path, typer.Option(help="Folder of the experiment.")] = Path("work")
    records: Annotated[
        list[str] | None,
        typer.Option(help="TFRecords: paths, patterns, folders or URLs; may be repeated."),
    ] = None
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            help="Settings laid over, from stages.yaml; several by comma, the last on top.",
        ),
    ] = None
    set: Annotated[
        list[str] | None,
        typer.Option("-s", "--set", help="stage.key=value, e.g. train.steps=100."),
    ] = None
    file: Annotated[
        Path | None, typer.Option(help="Another stages.yaml than ./stages.yaml.")
    ] = None

    @property
    def named_records(self) -> list[str]:
        """Records that the command names."""
        return [part for word in self.records or () for part in split_names(word)]

    def request(self, records: Sequence[str] = ()) -> Request:
        """Fill in from the root's memory what was not named."""
        return complete(
            Root(self.root.absolute()),
            file=self.file,
            profile=self.profile,
            records=[*self.named_records, *[p for w in records for p in split_names(w)]],
            overrides=self.set or (),
            environ=os.environ,
        )


@dataclass(frozen=True, slots=True)
class Running:
    """How to run; none of it decides what comes out."""

    dry_run: Annotated[bool, typer.Option("-n", "--dry-run", help="Only say what.")] = False
    force: Annotated[
        bool, typer.Option("-f", "--force", help="Make the named stages again.")
    ] = False
    begin: Annotated[
        str | None, typer.Option("--from", help="Make again from this stage on.")
    ] = None
    keep_going: Annotated[
        bool, typer.Option("-k", "--keep-going", help="Go on after a failed unit.")
    ] = False
    wait: Annotated[bool, typer.Option("--wait", help="Queue behind another run.")] = False
    dask: Annotated[
        str,
        typer.Option(
            help="none, local[:N], gpu[:0,1], tcp://HOST:PORT, file:scheduler.json."
        ),
    ] = "none"
    max_bad: Annotated[
        float, typer.Option(help="Largest share of records that may be quarantined.")
    ] = 0.001
    strict_code: Annotated[
        bool, typer.Option("--strict-code", help="Make again what other code made.")
    ] = False

    def orders(self, targets: Sequence[str], plan: Plan) -> Orders:
        """Say which stages are made again, and how the units are done."""
        again = set(targets or plan.stages) if self.force else set()
        if self.begin is not None:
            if self.begin not in plan.stages:
                there = ", ".join(plan.stages)
                raise PlanError(f"--from {self.begin}: not on the way; there is {there}")
            again.add(self.begin)
        return Orders(
            force=frozenset(again),
            keep_going=self.keep_going,
            wait=self.wait,
            strict_code=self.strict_code,
            workers=self.dask,
            visible_devices=os.environ.get("CUDA_VISIBLE_DEVICES"),
        )


@dataclass(frozen=True, slots=True)
class Comparing:
    """Which methods are trained, played and scored to be compared."""

    preset: Annotated[
        str | None, typer.Option(help="Train and compare methods, as in stages.yaml.")
    ] = None
    arms: Annotated[str | None, typer.Option(help="Of a preset: only these, by comma.")] = (
        None
    )
    seeds: Annotated[
        int | None, typer.Option(help="Of a preset: how many; default: its own.", min=1)
    ] = None

    @property
    def arm_names(self) -> list[str]:
        """Arms that are named."""
        return [name.strip() for name in (self.arms or "").split(",") if name.strip()]

    def comparison(self, asked: Asked, targets: Sequence[str]) -> Comparison:
        """Find the preset, and lay over it what else is asked.

        Raises:
            ConfigError: for a preset that does not exist.
        """
        root, name = Root(asked.root.absolute()), self.preset or ""
        before = recall(root, f"{PRESET}.{name}")
        path = find_file(asked.file, before)
        file = load_stages(path, os.environ)
        records = [absolute(pattern) for pattern in asked.named_records]
        return Comparison(
            root=root,
            path=path,
            file=file,
            preset=file.preset(name),
            profile=asked.profile,
            overrides=tuple(asked.set or ()),
            records=tuple(records or before.get("records", ())),
            targets=tuple(targets) or (REPORT,),
        )


@dataclass(frozen=True, slots=True)
class Scoring:
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
        """Score; tells how far it is."""
        from pipeline.wosac import score_files  # noqa: PLC0415

        names = split_names(self.records)
        return score_files(names, self.rollouts, self.metric, self.count, tell)


@dataclass(frozen=True, slots=True)
class Building:
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

    def write(self, tell: Callable[[Event], None]) -> "Written":
        """Write their records; tells how far it is."""
        from pipeline.towns import Order, write_towns  # noqa: PLC0415

        return write_towns(Order(**asdict(self)), tell)


@dataclass(frozen=True, slots=True)
class Exporting:
    """What is exported, in whose format and to where."""

    to: Annotated[
        str, typer.Option("--to", help="wosac, gpudrive, scenarionet or parquet.")
    ]
    out: Annotated[Path, typer.Option(help="Folder to write; of wosac a .tar.gz.")]
    rollouts: Annotated[
        Path | None, typer.Argument(help="Our rollouts; default: the root's latest.")
    ] = None
    root: Annotated[Path, typer.Option(help="Folder of the experiment.")] = Path("work")
    records: Annotated[
        str | None,
        typer.Option(help="Their logs: TFRecords, or an ingested folder; default: root's."),
    ] = None
    about: Annotated[
        Path | None, typer.Option(help="YAML file that tells who submits what (wosac).")
    ] = None
    scenes_per_shard: Annotated[int, typer.Option(help="Of wosac.", min=1)] = 300

    def write(self, tell: Callable[[Event], None]) -> "Exported":
        """Export; tells how far it is."""
        from pipeline.export import Order, export  # noqa: PLC0415
        from pipeline.export_wosac import read_about  # noqa: PLC0415
        from pipeline.logs import open_logs  # noqa: PLC0415

        root = Root(self.root.absolute())
        logs = split_names(self.records) if self.records else [str(root.latest / "ingest")]
        about = read_about(self.about, root) if self.about else None
        order = Order(
            to=self.to,
            rollouts=self.rollouts or root.latest / "rollout",
            logs=open_logs(logs),
            out=self.out,
            about=about,
            scenes_per_shard=self.scenes_per_shard,
        )
        return export(order, tell)


@dataclass(frozen=True, slots=True)
class Viewing:
    """What is watched, and what is written of it."""

    source: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ROOT | RECORDS...]", help="A root, or TFRecords to see a log of."
        ),
    ] = None
    root: Annotated[Path, typer.Option(help="Folder of the experiment.")] = Path("work")
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
        """Write it; tells how far it is."""
        from pipeline.view import Wanted, is_root, view  # noqa: PLC0415

        words = [part for word in self.source or () for part in split_names(word)]
        root = Path(words[0]) if len(words) == 1 and is_root(Path(words[0])) else None
        width_px, height_px = _size(self.size)
        wanted = Wanted(
            root=Root((root or self.root).absolute()),
            records=() if root else tuple(words),
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


def split_names(word: str) -> list[str]:
    """Split at commas, unless the whole is the name of a file."""
    return [word] if Path(word).exists() else [part for part in word.split(",") if part]


def gathers(**records: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a verb take the fields of some records as options, gathered in those records."""

    def decorate(verb: Callable[..., None]) -> Callable[..., None]:
        @wraps(verb)
        def gathered(**values: Any) -> None:
            for name, kind in records.items():
                given = {field.name: values.pop(field.name) for field in fields(kind)}
                values[name] = kind(**given)
            verb(**values)

        own = [
            p for p in inspect.signature(verb).parameters.values() if p.name not in records
        ]
        options = [option for kind in records.values() for option in _options(kind)]
        gathered.__signature__ = inspect.Signature([*own, *options])  # type: ignore[attr-defined]
        gathered.__annotations__ = {p.name: p.annotation for p in (*own, *options)}
        return gathered

    return decorate


def _options(kind: type) -> list[inspect.Parameter]:
    hints = get_type_hints(kind, include_extras=True)
    only_by_name = inspect.Parameter.KEYWORD_ONLY
    return [
        inspect.Parameter(
            f.name,
            only_by_name,
            default=inspect.Parameter.empty if f.default is MISSING else f.default,
            annotation=hints[f.name],
        )
        for f in fields(kind)
    ]
