"""``stages.yaml``: the stage graph, its settings, and the profiles laid over them.

::

    version: 1
    sources: ${INFGEN_RECORDS:-data/womd/*.tfrecord*}     # or a list of them
    stages:
      tokenize: {deps: [ingest, build-vocab], params: [tokenize]}
    params:
      tokenize: {max_gap_s: 1.0}
    profiles:
      small: {sources: builtin, train: {steps: 100}}
    presets: {}      # methods that are compared: see ``pipeline.settings.presets``

Profiles may be stacked: ``--profile small,paper-loss`` lays the second over the first.
A stage may name a ``module`` of its own that defines ``STAGE = Stage(...)``.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from infgen.errors import ConfigError
from pipeline.engine.plan import SOURCES, StageEntry
from pipeline.engine.registry import MODULES
from pipeline.settings.lined_yaml import (
    LinedMapping,
    did_you_mean,
    inner,
    known,
    load,
    words,
)
from pipeline.settings.overlay import Overlay, merge_overlays, read_overrides, read_sections
from pipeline.settings.preset_file import read_preset
from pipeline.settings.presets import Preset

FILE_VERSION = 1
DEFAULT_FILE = Path(__file__).with_name("default_stages.yaml")
_ENTRIES = ("version", SOURCES, "stages", "params", "profiles", "presets")


@dataclass(frozen=True, slots=True)
class StagesFile:
    """A whole ``stages.yaml``."""

    stages: Mapping[str, StageEntry]
    base: Overlay
    profiles: Mapping[str, Overlay]
    presets: Mapping[str, Preset] = field(default_factory=dict)

    def choose(
        self,
        profile: str | None,
        overrides: Sequence[str] = (),
        between: Sequence[Overlay] = (),
    ) -> Overlay:
        """Merge the base, profiles and ``section.key=value`` overrides, in this order.

        Args:
            profile: Names with commas between; later ones take precedence.
            overrides: The words.
            between: Laid over the profiles, below the words.

        Raises:
            ConfigError: for a profile or section that does not exist.
        """
        over = read_overrides(overrides, self.sections)
        return merge_overlays([self.base, *self.profile_overlays(profile), *between, over])

    def preset(self, name: str) -> Preset:
        """Find a preset.

        Raises:
            ConfigError: if there is none of that name.
        """
        if name not in self.presets:
            there = did_you_mean(name, list(self.presets))
            raise ConfigError(f"--preset {name}: no preset {name!r}{there}")
        return self.presets[name]

    def names_sources(self, profile: str | None) -> bool:
        """Whether one of the profiles names source files."""
        return any(overlay.sources for overlay in self.profile_overlays(profile))

    def profile_overlays(self, profile: str | None) -> list[Overlay]:
        """Return the overlays of profiles named with commas between."""
        names = [] if profile is None else profile.split(",")
        return [
            _pick(self.profiles, name.strip(), "profile", "--profile") for name in names
        ]

    @property
    def sections(self) -> list[str]:
        """All sections of settings that stages read."""
        found = [section for entry in self.stages.values() for section in entry.params]
        return list(dict.fromkeys(found))


def load_stages(path: Path, environ: Mapping[str, str]) -> StagesFile:
    """Read a ``stages.yaml``.

    Args:
        path: The file.
        environ: Variables for ``${NAME:-default}`` in the paths of sources.

    Raises:
        ConfigError: naming file, line, and what was expected there.
    """
    file = load(path)
    known(file, _ENTRIES, path.name)
    if file.get("version") != FILE_VERSION:
        found = file.get("version")
        raise ConfigError(f"{path.name}: version is {found!r}, expected {FILE_VERSION}")
    stages = {name: _stage(file, name) for name in inner(file, "stages")}
    sections = [section for entry in stages.values() for section in entry.params]
    return StagesFile(
        stages=stages,
        base=read_sections(inner(file, "params"), sections).with_sources(
            _sources(file, environ)
        ),
        profiles={
            name: _profile(inner(inner(file, "profiles"), name), sections, environ)
            for name in inner(file, "profiles")
        },
        presets={
            name: read_preset(
                inner(file, "presets"), name, sections, list(inner(file, "profiles"))
            )
            for name in inner(file, "presets")
        },
    )


def _stage(file: LinedMapping, name: str) -> StageEntry:
    entry = inner(inner(file, "stages"), name)
    where = inner(file, "stages").where(name)
    known(entry, ("deps", "params", "module"), name)
    module = entry.get("module", MODULES.get(name))
    if not isinstance(module, str):
        near = did_you_mean(name, list(MODULES))
        raise ConfigError(f"{where}: stage {name!r} needs a `module`{near}")
    return StageEntry(
        name=name,
        module=module,
        deps=words(entry, "deps"),
        params=words(entry, "params"),
        where=where,
    )


def _profile(
    entry: LinedMapping, sections: Sequence[str], environ: Mapping[str, str]
) -> Overlay:
    settings = LinedMapping(entry.file)
    for key, value in entry.items():
        if key != SOURCES:
            settings[key], settings.lines[key] = value, entry.lines[key]
    return read_sections(settings, sections).with_sources(_sources(entry, environ))


def _sources(entry: LinedMapping, environ: Mapping[str, str]) -> tuple[str, ...]:
    given = entry.get(SOURCES)
    if given is None:
        return ()
    paths = [given] if isinstance(given, str) else given
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise ConfigError(f"{entry.where(SOURCES)}: expected a path or a list of paths")
    return tuple(_expand(path, environ, entry.where(SOURCES)) for path in paths)


def _expand(path: str, environ: Mapping[str, str], where: str) -> str:
    def value(match: re.Match[str]) -> str:
        name, default = match.groups()
        if environ.get(name):
            return environ[name]
        if default is None:
            way = f"set it, or write ${{{name}:-default}}"
            raise ConfigError(f"{where}: variable {name} is not set; {way}")
        return str(default)

    return re.sub(r"\$\{(\w+)(?::-([^}]*))?\}", value, path)


def _pick(found: Mapping[str, Overlay], name: str, what: str, where: str) -> Overlay:
    if name not in found:
        raise ConfigError(
            f"{where} {name}: no {what} {name!r}{did_you_mean(name, list(found))}"
        )
    return found[name]
