"""Curves for TensorBoard, if enabled and installed."""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from infgen.errors import ConfigError


class EventFiles:
    """Writes numbers as curves. What lies beyond the first step is written anew."""

    def __init__(self, folder: Path, first: int) -> None:
        try:
            from tensorboardX import SummaryWriter  # noqa: PLC0415
        except ModuleNotFoundError as error:
            raise ConfigError(
                "train.tensorboard is true, but tensorboardX is not installed: "
                "pip install 'infgen[tensorboard]', or set it to false"
            ) from error
        self._writer = SummaryWriter(str(folder), purge_step=first + 1)

    def __enter__(self) -> "EventFiles":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()

    def add(self, group: str, step: int, figures: Mapping[str, Any]) -> None:
        """Add a point to the curve of every number among some figures."""
        for name, value in figures.items():
            if name != "step" and isinstance(value, int | float):
                self._writer.add_scalar(f"{group}/{name}", value, step)
