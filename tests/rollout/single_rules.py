"""Settings with some rules only."""

from typing import Any

from infgen.rollout.rules.rule_set import RULE_SETS

ALL_OFF: dict[str, Any] = {
    "rules": "safe",
    "max_motion_samples": 1,
    "reject_off_road": False,
    "max_stall_s": 0.0,
    "density_control": 0.0,
    "insertion_mask": False,
}


def only(**rules: Any) -> dict[str, Any]:
    """Settings with these rules, and no others."""
    assert all(hasattr(RULE_SETS["none"], name) for name in rules)
    return {**ALL_OFF, **rules}
