"""State of every stage on disk compared with a plan, with reasons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.engine.atomic import MANIFEST, StoreError
from pipeline.engine.code_hash import code_hash
from pipeline.engine.inputs import FinishedInputs, inputs_finished
from pipeline.engine.layout import read_json
from pipeline.engine.locks import holder, is_locked
from pipeline.engine.manifest import read_manifest
from pipeline.engine.plan import Plan, PlanError, PlannedStage

State = Literal["cached", "stale", "missing", "running", "failed"]
OTHER_CODE = "code differs from the run that made this"
MAX_NAMES = 3


@dataclass(frozen=True, slots=True)
class StageStatus:
    """State of one stage.

    Attributes:
        stage: Its name.
        state: ``cached``: made under this key. ``stale``: made under another key only.
            ``missing``: never made. ``running``: being made now. ``failed``: the last
            attempt under this key failed.
        why: The reasons.
        key: Its key.
        units: Number of its units, if known.
        made: Number of finished units, if known.
    """

    stage: str
    state: State
    why: str
    key: str
    units: int | None
    made: int | None

    @property
    def progress(self) -> str:
        """Finished and all units, as ``12/27``."""
        return "" if self.units is None else f"{self.made}/{self.units}"


def stage_statuses(
    plan: Plan, made: Mapping[str, str], *, strict_code: bool = False
) -> list[StageStatus]:
    """Return the state of every planned stage.

    Args:
        plan: The plan.
        made: Keys of the stages made last, with which stale stages are compared.
        strict_code: Whether changed code makes a stage stale.
    """
    return [_stage_status(plan, name, made, strict_code) for name in plan.stages]


def _stage_status(
    plan: Plan, name: str, made: Mapping[str, str], strict_code: bool
) -> StageStatus:
    planned, root = plan[name], plan.root
    other_code = code_differs(plan, name)
    if root.is_finished(name, planned.key) and not (strict_code and other_code):
        units = len(read_manifest(root.folder(name, planned.key))["units"])
        why = OTHER_CODE if other_code else ""
        return StageStatus(name, "cached", why, planned.key, units, units)
    try:
        total, done = count_units(plan, planned)
    except PlanError as error:  # Shown as the reason; the other stages are listed too.
        return StageStatus(name, "missing", str(error), planned.key, None, None)
    reasons = (
        [OTHER_CODE]
        if other_code
        else stale_reasons(plan, name, _last_manifest(plan, name, made))
    )
    state: State = "stale" if reasons else "missing"
    reasons = reasons or ["not made yet"]
    attempt = last_attempt(plan, name)
    if attempt.get("failed"):
        state, reasons = "failed", _failures(attempt["failed"])
    if is_locked(root.lock(name)):
        about = holder(root.lock(name))
        state = "running"
        reasons = [f"process {about.get('pid')} on {about.get('host')}"]
    if done and not other_code:
        reasons = [*reasons, f"{done} of {total} units made"]
    return StageStatus(name, state, "; ".join(reasons), planned.key, total, done)


def code_differs(plan: Plan, name: str) -> bool:
    """Whether a stage is made, but its code has changed since."""
    folder = plan.root.folder(name, plan[name].key)
    if not (folder / MANIFEST).is_file():
        return False
    return read_manifest(folder).get("code") != code_hash(plan[name].stage.modules)


def last_attempt(plan: Plan, name: str) -> Mapping[str, Any]:
    """Return the record of an unfinished attempt under the planned key."""
    try:
        attempt = read_json(plan.root.attempt(name))
    except StoreError:
        return {}
    return attempt if attempt.get("key") == plan[name].key else {}


def count_units(plan: Plan, planned: PlannedStage) -> tuple[int | None, int | None]:
    """Count all and finished units; None while the inputs are not made."""
    if not inputs_finished(plan, planned):
        return None, None
    units = planned.stage.plan(FinishedInputs(plan.root, planned), planned.settings)
    folders = [plan.root.unit(planned.name, planned.unit_key(unit)) for unit in units]
    return len(units), sum((folder / MANIFEST).is_file() for folder in folders)


def _failures(failed: Mapping[str, str]) -> list[str]:
    name, error = next(iter(failed.items()))
    more = f" (and {len(failed) - 1} more units)" if len(failed) > 1 else ""
    return [f"{name}: {error}{more}"]


def _last_manifest(
    plan: Plan, name: str, made: Mapping[str, str]
) -> Mapping[str, Any] | None:
    """Manifest of the stage as made last under this profile, or else at all."""
    root = plan.root
    if name in made and root.is_finished(name, made[name]):
        return read_manifest(root.folder(name, made[name]))
    folder = root.latest_folder(name)
    return read_manifest(folder) if folder is not None else None


def stale_reasons(plan: Plan, name: str, old: Mapping[str, Any] | None) -> list[str]:
    """List why a stage's key differs from that of an old manifest; empty without one."""
    if old is None:
        return []
    planned = plan[name]
    own = [
        *_version_reasons(old.get("version"), planned.stage.version),
        *_setting_reasons(old.get("settings", {}), planned.values),
        *_source_reasons(
            old.get("sources", {}),
            {source.name: source.fingerprint for source in planned.sources},
        ),
    ]
    for dep, key in planned.inputs.items():
        was = old.get("inputs", {}).get(dep)
        if was != key:
            own += [
                reason for reason in _input_reasons(plan, dep, was) if reason not in own
            ]
    return own


def _input_reasons(plan: Plan, dep: str, was: str | None) -> list[str]:
    if was is None:
        return [f"new input {dep}"]
    if not plan.root.is_finished(dep, was):
        return [f"input {dep}: differs from what it was"]
    reasons = stale_reasons(plan, dep, read_manifest(plan.root.folder(dep, was)))
    return [
        reason if reason.startswith("input ") else f"input {dep}: {reason}"
        for reason in reasons
    ]


def _version_reasons(old: Any, new: int) -> list[str]:
    return [] if old == new else [f"code version {old} -> {new}"]


def _setting_reasons(
    old: Mapping[str, Mapping[str, Any]], new: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    reasons = []
    for section in sorted(old.keys() | new.keys()):
        before, after = old.get(section, {}), new.get(section, {})
        for name in sorted(before.keys() | after.keys()):
            was, now = before.get(name, "unset"), after.get(name, "unset")
            if was != now:
                reasons.append(f"{section}.{name} {was} -> {now}")
    return reasons


def _source_reasons(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
    added = [name for name in new if name not in old]
    gone = [name for name in old if name not in new]
    changed = [name for name in new if name in old and new[name] != old[name]]
    kinds = (("new", added), ("changed", changed), ("removed", gone))
    return [_count(kind, names) for kind, names in kinds if names]


def _count(kind: str, names: Sequence[str]) -> str:
    shown = ", ".join(sorted(names)[:MAX_NAMES])
    more = ", ..." if len(names) > MAX_NAMES else ""
    return f"{len(names)} {kind} {'file' if len(names) == 1 else 'files'} {shown}{more}"
