"""Full-size vocabularies made by rule.

What a step costs does not depend on which moves there are, so benchmarks need no data.
"""

from functools import cache

import numpy as np

from infgen.config import VocabSettings
from infgen.tokens.clustering.made_map_samples import make_arcs
from infgen.tokens.clustering.made_motion_samples import make_fan
from infgen.tokens.clustering.physical_limits import motion_limits
from infgen.tokens.vocabulary import BOX_LW_M, MapVocabulary, MotionVocabulary

FAN_SPACING_M, ARC_SPACING_M = (0.1, 0.025, 0.05), 0.05
"""By kind: fine enough to fill a vocabulary."""


@cache
def made_vocabularies() -> tuple[MotionVocabulary, MapVocabulary]:
    """Make vocabularies of the default sizes."""
    settings = VocabSettings()
    moves, roads = settings.num_motion_tokens, settings.num_map_tokens
    still = np.zeros((1, 6, 3), dtype=np.float32)
    limits = motion_limits(settings)
    path = np.stack(
        [
            np.concatenate([still, make_fan(agent_type, limits, spacing_m)])[:moves]
            for agent_type, spacing_m in enumerate(FAN_SPACING_M)
        ]
    )
    motion = MotionVocabulary(BOX_LW_M, path, np.zeros(path.shape[:2], dtype=bool))
    curve_m = make_arcs(ARC_SPACING_M)[:roads]
    return motion, MapVocabulary(curve_m, np.zeros(len(curve_m), dtype=bool))
