"""All settings in one place: ``stages.yaml`` and ``-s key=value`` become these classes.

Each class lives in the package it acts in. Whoever needs one class inside ``infgen``
imports it from there.
"""

from infgen.metrics.settings import ReferenceSettings as ReferenceSettings
from infgen.metrics.settings import ScoreSettings as ScoreSettings
from infgen.model.settings import ModelSettings as ModelSettings
from infgen.model.training_settings import TrainSettings as TrainSettings
from infgen.rollout.calibration_settings import CalibrateSettings as CalibrateSettings
from infgen.rollout.settings import RolloutSettings as RolloutSettings
from infgen.sources.settings import IngestSettings as IngestSettings
from infgen.tokens.clustering.settings import VocabSettings as VocabSettings
from infgen.tokens.settings import TokenSettings as TokenSettings
from infgen.views.settings import ReportSettings as ReportSettings
