"""Which records a comparison reads: those that are named, or towns of its own."""

from collections.abc import Callable, Iterator
from pathlib import Path

from infgen.errors import ConfigError
from pipeline.comparison.runs import Comparison
from pipeline.engine.events import Event
from pipeline.storage.sources.source_files import find_records as find_raw
from pipeline.storage.towns import Order, write_towns

TOWNS = "towns"


def find_records(comparison: Comparison, tell: Callable[[Event], None]) -> Comparison:
    """Settle which records all runs read; a preset's own towns are written if need be.

    Files that are there are kept: what was killed goes on where it stopped.

    Raises:
        ConfigError: if no records are named, and the preset has no towns of its own; or if
            the root holds other towns.
        SumoError: if towns cannot be built.
    """
    if _are_named(comparison):
        return comparison
    orders = list(town_orders(comparison))
    for order in orders:
        write_towns(order, tell)
    return comparison.with_records([_pattern(order) for order in orders])


def town_orders(comparison: Comparison) -> Iterator[Order]:
    """Towns that a comparison writes, unless its records are named."""
    for split, towns in comparison.preset.towns.items():
        yield Order(
            out=comparison.root.path / TOWNS,
            scenes=towns.scenes,
            seconds=towns.seconds,
            seed=towns.seed,
            split=split,
            scenes_per_file=towns.scenes_per_file,
            variety=towns.variety,
            scenes_per_town=towns.scenes_per_town,
        )


def waits_for_towns(comparison: Comparison) -> int:
    """Count the files of towns that are still to be written."""
    if _are_named(comparison):
        return 0
    paths: list[Path] = [path for each in town_orders(comparison) for path in each.paths]
    return sum(not path.is_file() for path in paths)


def with_towns(comparison: Comparison) -> Comparison:
    """Read towns that are all written already."""
    if _are_named(comparison):
        return comparison
    return comparison.with_records([_pattern(each) for each in town_orders(comparison)])


def _are_named(comparison: Comparison) -> bool:
    """Whether the command, a profile or the file says what to read.

    Raises:
        ConfigError: if nothing does.
    """
    names = [*comparison.preset.profile, *(comparison.profile or "").split(",")]
    stack = ",".join(name for name in names if name) or None
    if comparison.records or comparison.file.names_sources(stack):
        return True
    if comparison.preset.towns:
        return False
    try:
        find_raw(comparison.file.base.sources)
    except ConfigError as error:
        raise ConfigError(
            f"preset {comparison.preset.name} reads records of your own; name them: "
            f"--records 'DIR/*.tfrecord*' ({error})"
        ) from error
    return True


def _pattern(order: Order) -> str:
    """Pattern of the files of an order, and of no others."""
    first = order.paths[0]
    return str(first.with_name(first.name.replace("-00000-of-", "-*-of-")))
