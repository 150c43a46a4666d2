"""Full-size codebooks made by rule.

What a step costs does not depend on which moves there are, so benchmarks need no data.
"""

import numpy as np

from infgen.config import VocabSettings
from infgen.tokens.clustering.made_map_samples import line_arcs
from infgen.tokens.clustering.made_motion_samples import fan
from infgen.tokens.clustering.physical_limits import limits_of
from infgen.tokens.vocabulary import BOX_LW_M, MapVocabulary, MotionVocabulary

FAN_SPACING_M, ARC_SPACING_M = (0.1, 0.025, 0.05), 0.05
"""By kind: fine enough to fill a codebook."""


def made_codebooks() -> tuple[MotionVocabulary, MapVocabulary]:
    """Make codebooks of the default sizes."""
    settings = VocabSettings()
    moves, roads = settings.num_motion_tokens, settings.num_map_tokens
    still = np.zeros((1, 6, 3), dtype=np.float32)
    limits = limits_of(settings)
    path = np.stack(
        [
            np.concatenate([still, fan(kind, limits, spacing_m)])[:moves]
            for kind, spacing_m in enumerate(FAN_SPACING_M)
        ]
    )
    motion = MotionVocabulary(BOX_LW_M, path, np.zeros(path.shape[:2], dtype=bool))
    curve_m = line_arcs(ARC_SPACING_M)[:roads]
    return motion, MapVocabulary(curve_m, np.zeros(len(curve_m), dtype=bool))
