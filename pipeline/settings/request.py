"""Requests: what a command asks of a root, stored in the root for later commands.

A command names records, a profile and settings, or takes them from the last request:
``infgen status --root R`` reports on the last run. A command that names a profile or
records starts a new request, without the settings of the last one.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from infgen.errors import ConfigError
from pipeline.engine.atomic import StoreError, naming_refusals, write_file, write_json
from pipeline.engine.layout import Root, link, read_json
from pipeline.engine.plan import Plan, PlanError, make_plan
from pipeline.settings.lined_yaml import LinedMapping, inner, load
from pipeline.settings.stages_file import DEFAULT_FILE, StagesFile, load_stages
from pipeline.storage.initial_weights import INITIAL_WEIGHTS
from pipeline.storage.sources.source_files import absolute

NO_PROFILE = "default"
LAST = "last"
OWN_FILE = "stages.yaml"


@dataclass(frozen=True, slots=True)
class Request:
    """Everything that decides what a run makes.

    Attributes:
        root: The root.
        file: Its ``stages.yaml``.
        profile: Its profiles; None for none.
        records: Paths, patterns or URLs; empty to use those of the file.
        overrides: ``section.key=value`` words.
    """

    root: Root
    file: Path
    profile: str | None
    records: tuple[str, ...]
    overrides: tuple[str, ...]

    @property
    def words(self) -> str:
        """The request as command-line options."""
        records = [f"--records {pattern}" for pattern in self.records]
        profile = [f"--profile {self.profile}"] if self.profile else []
        return " ".join([*profile, *records, *[f"-s {word}" for word in self.overrides]])

    def stages(self, environ: Mapping[str, str]) -> StagesFile:
        """Read the request's ``stages.yaml``."""
        return load_stages(self.file, environ)

    def plan(self, targets: Sequence[str], environ: Mapping[str, str]) -> Plan:
        """Plan the targets (all stages if there are none) and what they need."""
        file = self.stages(environ)
        chosen = file.choose(self.profile, self.overrides)
        if self.records:
            chosen = chosen.with_sources(self.records)
        return make_plan(self.root, file.stages, chosen, targets or list(file.stages))

    def made(self) -> Mapping[str, str]:
        """Keys of the stages that the last run under this profile planned."""
        return read_request(self.root, self._name).get("keys", {})

    def remember(self, plan: Plan, name: str | None = None) -> None:
        """Store this as the root's last request.

        Args:
            plan: Its plan.
            name: Name to store it under; the profile if None.
        """
        name = name or self._name
        before = read_request(self.root, name).get("keys", {})
        about = {
            "profile": self.profile,
            "records": self.records,
            "overrides": self.overrides,
            "file": None if self.file == DEFAULT_FILE else str(self.file),
            "keys": {**before, **{stage: plan[stage].key for stage in plan.stages}},
        }
        path = request_file(self.root, name)
        with naming_refusals(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, about)
        link(self.root.refs / LAST, path)

    @contextmanager
    def remembered(self, plan: Plan, name: str | None = None) -> Iterator[None]:
        """Store this while it runs, and restore the last request if it is refused.

        Other commands see it while it runs, and the run after a kill continues it. Settings
        that a stage refuses only then must not be used by the next command.
        """
        last, path = self.root.refs / LAST, request_file(self.root, name or self._name)
        latest_folder = last.resolve() if last.exists() else None
        before = path.read_bytes() if path.is_file() else None
        self.remember(plan, name)
        ours = path.read_bytes()
        try:
            yield
        except (ConfigError, PlanError):
            if path.is_file() and path.read_bytes() == ours:  # No other request since.
                _restore(last, latest_folder, path, before)
            raise

    @property
    def _name(self) -> str:
        return self.profile or NO_PROFILE


def complete_request(
    root: Root,
    *,
    file: Path | None,
    profile: str | None,
    records: Sequence[str],
    overrides: Sequence[str],
    environ: Mapping[str, str],
) -> Request:
    """Complete a command's request from those stored in the root."""
    last = read_request(root, LAST)
    fresh = profile is not None or bool(records)
    before = last if profile is None else read_request(root, profile)
    profile = profile or last.get("profile")
    request = Request(
        root=root,
        file=find_file(file, before or last),
        profile=profile,
        records=tuple(absolute(pattern) for pattern in records),
        overrides=(*(() if fresh else before.get("overrides", ())), *overrides),
    )
    if not records:
        request = _with_known_records(request, before, last, environ)
    return request


def _with_known_records(
    request: Request,
    before: Mapping[str, Any],
    last: Mapping[str, Any],
    environ: Mapping[str, str],
) -> Request:
    """Use the records of this profile's last request, the file, or the last request."""
    known = before.get("records", ())
    if not known and not request.stages(environ).names_sources(request.profile):
        known = last.get("records", ())
    return Request(
        request.root, request.file, request.profile, tuple(known), request.overrides
    )


def find_file(named: Path | None, before: Mapping[str, Any]) -> Path:
    """Choose the ``stages.yaml``: named, of this folder, remembered, or packaged."""
    own = Path(OWN_FILE)
    if named is not None:
        return named.absolute()
    if own.is_file():
        return own.absolute()
    remembered = before.get("file")
    return Path(remembered) if remembered else DEFAULT_FILE


def _restore(
    last: Path, latest_folder: Path | None, path: Path, before: bytes | None
) -> None:
    """Restore the request stored under a name, and the last request."""
    if last.resolve() == path.resolve():
        last.unlink()
        if latest_folder is not None:
            link(last, latest_folder)
    if before is None:
        path.unlink()
    else:
        write_file(path, before)


def request_file(root: Root, name: str) -> Path:
    """File of the request stored under a name."""
    return root.refs / f"{name}.json"


def read_request(root: Root, name: str) -> dict[str, Any]:
    """Return the request stored under a name; empty if missing or damaged."""
    path = root.refs / LAST if name == LAST else request_file(root, name)
    try:
        about = read_json(path)
    except StoreError:
        return {}
    return about if isinstance(about, dict) else {}


def named_weights(root: Root) -> set[str]:
    """Return the initial weights that stored requests and their files name."""
    requests = [read_json(path) for path in sorted(root.refs.glob("*.json"))]
    found = set()
    for word in (word for request in requests for word in request.get("overrides", ())):
        setting, _, value = word.partition("=")
        if setting.endswith(f".{INITIAL_WEIGHTS}"):
            found.add(value)
    for path in {Path(request.get("file") or DEFAULT_FILE) for request in requests}:
        file = load(path) if path.is_file() else LinedMapping(path.name)
        for part in ("params", "profiles"):
            found |= set(_named_in(inner(file, part)))
    return found - {""}


def _named_in(settings: Mapping[str, Any]) -> Iterator[str]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from _named_in(value)
        elif name == INITIAL_WEIGHTS:
            yield str(value)
