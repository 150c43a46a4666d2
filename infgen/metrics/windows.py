"""Sliding windows over the token steps after now: 8 s long, one every 0.5 s."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from infgen.clock import CLOCK


@dataclass(frozen=True, slots=True)
class Windows:
    """Windows over a future of so many token steps.

    Attributes:
        num_tokens: Token steps of the future.
        length: Token steps of a window.
        stride: Token steps from one window to the next.
    """

    num_tokens: int
    length: int
    stride: int

    @property
    def count(self) -> int:
        """Number of whole windows; 45 in 30 s."""
        return max(0, (self.num_tokens - self.length) // self.stride + 1)

    @property
    def starts(self) -> Int64[np.ndarray, " window"]:
        """First half second of each window."""
        return np.arange(self.count, dtype=np.int64) * self.stride

    @property
    def num_steps(self) -> int:
        """Steps of the future that lie in whole token steps."""
        return self.num_tokens * CLOCK.steps_per_token

    def sum_tokens(
        self, values: Shaped[np.ndarray, "*rows token"]
    ) -> Float64[np.ndarray, "*rows window"]:
        """Sum values per half second over each window."""
        total = np.cumsum(values, axis=-1, dtype=np.float64)
        total = np.concatenate([np.zeros((*total.shape[:-1], 1)), total], axis=-1)
        return total[..., self.starts + self.length] - total[..., self.starts]

    def sum_steps(
        self, values: Shaped[np.ndarray, "*rows step"]
    ) -> Float64[np.ndarray, "*rows window"]:
        """Sum values per step over each window."""
        shape = (*values.shape[:-1], self.num_tokens, CLOCK.steps_per_token)
        per_token = values[..., : self.num_steps].reshape(shape).sum(-1, dtype=np.float64)
        return self.sum_tokens(per_token)

    def covering(
        self, token: Int64[np.ndarray, " event"]
    ) -> Int64[np.ndarray, "event window"]:
        """Tell (1 or 0) which windows hold each token step."""
        inside = (token[:, None] >= self.starts) & (
            token[:, None] < self.starts + self.length
        )
        return inside.astype(np.int64)


def cut_windows(num_steps: int, window_s: float, stride_s: float) -> Windows:
    """Cut a future of so many steps into windows.

    Raises:
        ValueError: if a duration is not a whole number of token steps.
    """
    return Windows(
        num_tokens=num_steps // CLOCK.steps_per_token,
        length=CLOCK.tokens_in(window_s),
        stride=CLOCK.tokens_in(stride_s),
    )
