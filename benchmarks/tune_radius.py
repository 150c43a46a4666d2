"""Sweep the radius of the heuristic for models that neither insert nor remove (SPEC 7.1).

Reads the finished stages of a root whose rollouts were made on the validation split with
``-s rollout.insert=false -s rollout.remove=false``::

    python benchmarks/tune_radius.py ROOT [--protocol corrected]

Prints placement by radius; the last line is one JSON object with the best, to be given as
``-s score.presence_radius_m=R``.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from infgen.config import ReferenceSettings
from infgen.metrics.long_term.protocols import PROTOCOLS
from infgen.metrics.long_term.tune_radius import best_radius_m, placement_by_radius
from infgen.settings import build
from pipeline.engine.manifest import read_manifest
from pipeline.stages.reference_files import read_against
from pipeline.storage.rollouts import read_rollouts
from pipeline.storage.scene_lookup import unit_folders


def main(arguments: Sequence[str] | None = None) -> None:
    """Print placement by radius, and the best radius."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("root", type=Path, help="root with stages reference and rollout")
    names = {protocol.name: protocol for protocol in PROTOCOLS}
    parser.add_argument("--protocol", choices=names, default="corrected")
    options = parser.parse_args(arguments)
    folder = options.root / "latest" / "reference"
    values = read_manifest(folder)["settings"]["reference"]
    against = read_against(folder, {}, build(ReferenceSettings, values, "reference"))
    units = unit_folders(options.root / "latest" / "rollout") or []
    rollouts = (rollout for unit in units for rollout in read_rollouts(unit))
    placement = placement_by_radius(rollouts, against, names[options.protocol])
    for radius_m, value in placement.items():
        print(f"{radius_m:6.1f} m  {value:.4f}")
    best_m = best_radius_m(placement)
    print(json.dumps({"presence_radius_m": best_m, "placement": placement[best_m]}))


if __name__ == "__main__":
    main()
