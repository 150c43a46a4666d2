"""Options that several verbs share, gathered in records, and verbs that take them."""

import inspect
import os
from collections.abc import Callable, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from infgen.errors import ConfigError
from pipeline.comparison.runs import PRESET, REPORT, Comparison
from pipeline.engine.layout import find_root
from pipeline.engine.plan import Plan, PlanError
from pipeline.engine.runner import RunOptions
from pipeline.settings.request import Request, complete_request, find_file, read_request
from pipeline.settings.stages_file import load_stages
from pipeline.storage.sources.source_files import absolute
from pipeline.workers.dask_cluster import choose_workers

RootFolder = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Folder of the experiment.")
]
Json = Annotated[
    bool, typer.Option("--json", help="Print JSON: a line, or more on a terminal.")
]
WORK = Path("work")
"""The root where none is named."""
StrictCode = Annotated[
    bool,
    typer.Option(
        "--strict-code",
        help="Also count as stale what was made by another version of the code.",
    ),
]


@dataclass(frozen=True, slots=True)
class RequestOptions:
    """What names a request; what is not named is as in the root's last run."""

    root: RootFolder = WORK
    records: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RECORDS",
            help="TFRecords: paths, patterns, folders or URLs; may be repeated.",
        ),
    ] = None
    profile: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Settings laid over, from stages.yaml; several by comma, the last on top.",
        ),
    ] = None
    set: Annotated[
        list[str] | None,
        typer.Option(
            *("-s", "--set"),
            metavar="KEY=VALUE",
            help="A setting, e.g. train.steps=100; may be repeated. `infgen settings` "
            "lists them.",
        ),
    ] = None
    file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Another stages.yaml than ./stages.yaml."),
    ] = None

    @property
    def named_records(self) -> list[str]:
        """Records that the command names."""
        return [part for word in self.records or () for part in split_names(word)]

    def request(self, records: Sequence[str] = ()) -> Request:
        """Fill in from the root's memory what was not named."""
        return complete_request(
            find_root(self.root),
            file=self.file,
            profile=self.profile,
            records=[*self.named_records, *[p for w in records for p in split_names(w)]],
            overrides=self.set or (),
            environ=os.environ,
        )


@dataclass(frozen=True, slots=True)
class DriveOptions:
    """What is driven, and where the page is."""

    scene: Annotated[
        str, typer.Argument(help="Start of a scene's id; default: the first.")
    ] = ""
    weights: Annotated[
        str, typer.Option(help="A folder, or builtin; default: the root's, or builtin.")
    ] = ""
    seed: Annotated[int, typer.Option(help="Other traffic for another seed.", min=0)] = 0
    out: Annotated[
        Path | None, typer.Option(help="Folder to save drives in; default: ROOT/drives.")
    ] = None
    port: Annotated[
        int, typer.Option(help="Of the page; 0: any free one.", min=0, max=65535)
    ] = 0
    browser: Annotated[bool, typer.Option(help="Open the page in a browser.")] = True

    def serve(
        self,
        request_options: RequestOptions,
        say: Callable[[str], None],
        log: Callable[[str], None],
    ) -> None:
        """Serve the page until a signal arrives; its address is said."""
        from pipeline.commands.drive import Wanted, drive  # noqa: PLC0415

        request = request_options.request()
        wanted = Wanted(
            request=request,
            file=request.stages(os.environ),
            profile=request_options.profile,
            records=tuple(request_options.named_records),
            **asdict(self),
        )
        drive(wanted, say, log)


@dataclass(frozen=True, slots=True)
class RunFlags:
    """How to run; none of it decides what comes out."""

    dry_run: Annotated[
        bool,
        typer.Option("-n", "--dry-run", help="Make nothing; say what would be, and why."),
    ] = False
    force: Annotated[
        bool,
        typer.Option(
            "-f", "--force", help="Make the named stages again, though they are there."
        ),
    ] = False
    begin: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="STAGE",
            help="Make this stage again, and all on the way that depends on it.",
        ),
    ] = None
    keep_going: Annotated[
        bool, typer.Option("-k", "--keep-going", help="Go on after a failed unit.")
    ] = False
    wait: Annotated[bool, typer.Option("--wait", help="Queue behind another run.")] = False
    dask: Annotated[
        str,
        typer.Option(
            metavar="WHERE",
            help="none, local[:N], gpu[:0,1], tcp://HOST:PORT, file:scheduler.json.",
        ),
    ] = "none"
    unit_timeout: Annotated[
        float,
        typer.Option(
            metavar="MINUTES",
            help="A unit that takes a Dask worker longer fails; 0: never.",
            min=0,
        ),
    ] = 1440.0
    max_bad: Annotated[
        float,
        typer.Option(
            metavar="SHARE", help="Largest share of records that may be quarantined."
        ),
    ] = 0.001
    strict_code: Annotated[
        bool,
        typer.Option(
            "--strict-code",
            help="Also make again what was made by another version of the code.",
        ),
    ] = False

    def run_options(self, targets: Sequence[str], plan: Plan) -> RunOptions:
        """Say which stages are made again, and how the units are done."""
        again = set(targets or plan.stages) if self.force else set()
        if self.begin is not None:
            if self.begin not in plan.stages:
                there = ", ".join(plan.stages)
                raise PlanError(f"--from {self.begin}: not on the way; there is {there}")
            again.add(self.begin)
        return RunOptions(
            force=frozenset(again),
            keep_going=self.keep_going,
            wait=self.wait,
            strict_code=self.strict_code,
            workers=choose_workers(
                self.dask,
                os.environ.get("CUDA_VISIBLE_DEVICES"),
                unit_limit_s=60 * self.unit_timeout,
            ),
        )


@dataclass(frozen=True, slots=True)
class ComparisonOptions:
    """Which methods are trained, simulated, scored and compared."""

    preset: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Train and compare methods, as in stages.yaml."),
    ] = None
    arms: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Of a preset: only these, by comma."),
    ] = None
    seeds: Annotated[
        int | None,
        typer.Option(metavar="N", help="Of a preset: how many; default: its own.", min=1),
    ] = None

    def __post_init__(self) -> None:
        """Refuse what says nothing without a preset.

        Raises:
            ConfigError: naming it.
        """
        alone = {"--arms": self.arms, "--seeds": self.seeds}
        for word, value in alone.items():
            if self.preset is None and value is not None:
                raise ConfigError(
                    f"{word} {value} is said of a preset, but none is named; expected "
                    f"--preset NAME beside it, or no {word}"
                )

    @property
    def arm_names(self) -> list[str]:
        """Arms that are named."""
        return [name.strip() for name in (self.arms or "").split(",") if name.strip()]

    def comparison(
        self, request_options: RequestOptions, targets: Sequence[str]
    ) -> Comparison:
        """Find the preset, and merge the other options into it.

        Raises:
            ConfigError: for a preset that does not exist.
        """
        root, name = find_root(request_options.root), self.preset or ""
        before = read_request(root, f"{PRESET}.{name}")
        path = find_file(request_options.file, before)
        file = load_stages(path, os.environ)
        records = [absolute(pattern) for pattern in request_options.named_records]
        return Comparison(
            root=root,
            path=path,
            file=file,
            preset=file.preset(name),
            profile=request_options.profile,
            overrides=tuple(request_options.set or ()),
            records=tuple(records or before.get("records", ())),
            targets=tuple(targets) or (REPORT,),
        )


@dataclass(frozen=True, slots=True)
class EstimateOptions:
    """For how many workers, and how long, the work of a preset is planned."""

    dask: Annotated[
        str,
        typer.Option(
            metavar="WHERE", help="Of a preset: workers, as `infgen run` has them."
        ),
    ] = "none"
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Of a preset: say how many steps and scenes fit into 24h, 90m or 2d.",
        ),
    ] = None

    def refuse_without_preset(self) -> None:
        """Refuse a budget where nothing is estimated.

        Raises:
            ConfigError: naming it.
        """
        if self.budget is not None:
            raise ConfigError(
                f"--budget {self.budget} is said of a preset, but none is named; expected "
                "--preset NAME beside it, or no --budget"
            )


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
