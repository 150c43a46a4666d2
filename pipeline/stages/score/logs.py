"""A unit of stage ``score`` that scores logs: the ceiling for any rollout."""

from pathlib import Path

from infgen.config import ReferenceSettings
from infgen.metrics.long_term.table import make_row
from pipeline.stages.reference_files import read_against, read_binned, read_logged
from pipeline.stages.score.summary import Tally
from pipeline.stages.score.write import ROWS, rows_of, write_part, write_tally

LOG_PREFIX = "log/"
"""Before the metrics of a log that is scored as if it were a rollout."""


def score_logs(
    unit: Path, reference: Path, target: Path, settings: ReferenceSettings
) -> int:
    """Score the logs of a file as if they were rollouts.

    Args:
        unit: The unit of stage ``reference`` that binned them.
        reference: The finished stage, with the counts of all logs.
        target: Where the scores are written.
        settings: Of that stage.

    Returns:
        How many logs there are.
    """
    against = read_against(reference, read_logged(unit), settings)
    tally, rows = Tally(), []
    for binned in read_binned(unit):
        row = make_row(binned, against)
        tally.add(binned.scenario_id, row)
        rows += rows_of(binned.scenario_id, None, row.numbers, LOG_PREFIX)
    tally.close_unit()
    write_part(target / ROWS, rows)
    write_tally(target, tally)
    return len(tally.means)
