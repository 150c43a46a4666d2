"""Every setting, as frozen dataclasses, one per stage; each lives in the room it acts in.

``stages.yaml`` and ``-s key=value`` become these through ``build``, once, before anything
runs. A value that follows from others is a property, not a setting.
"""

from infgen.coerce import ConfigError as ConfigError
from infgen.coerce import build as build
from infgen.coerce import key_values as key_values
from infgen.coerce import settle as settle
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
