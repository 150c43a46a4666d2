"""Time: 0.1 s steps and 0.5 s tokens. The only place that turns one into the other.

Token ``k`` spans steps ``5k`` to ``5k + 5``, both ends included; its pose is the pose at
the last of them. A log of 91 steps holds 18 tokens; the last step of the history (step 10,
"now") is the end of token 1.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Clock:
    """How steps and tokens count time.

    Attributes:
        step_s: Seconds between two steps of a log.
        steps_per_token: Steps that one token spans.
    """

    step_s: float = 0.1
    steps_per_token: int = 5

    @property
    def token_s(self) -> float:
        """Seconds that one token spans."""
        return self.step_s * self.steps_per_token

    def num_tokens(self, num_steps: int) -> int:
        """Count the whole tokens in a log of so many steps."""
        return max(0, (num_steps - 1) // self.steps_per_token)

    def start_step(self, token: int) -> int:
        """Return the step at which a token starts."""
        return token * self.steps_per_token

    def end_step(self, token: int) -> int:
        """Return the step at which a token ends: the step of its pose."""
        return (token + 1) * self.steps_per_token

    def token_ending_at(self, step: int) -> int:
        """Return the last token that has ended by this step (-1 if none has)."""
        return step // self.steps_per_token - 1

    def tokens_in(self, seconds: float) -> int:
        """Count the tokens that fit a duration.

        Raises:
            ValueError: if the duration is not a whole number of tokens.
        """
        count = round(seconds / self.token_s)
        if count < 1 or abs(count * self.token_s - seconds) > 1e-6:
            raise ValueError(
                f"{seconds} s is not a whole number of {self.token_s} s tokens; "
                f"try {max(1, count) * self.token_s:g} s"
            )
        return count


CLOCK = Clock()
