"""Who is there: from what the log shows of each agent to the states of its life (SPEC 3.3).

A token is *seen* if the log shows the agent at both its ends. An agent enters at its first
seen token and leaves at its last one. What it does while it enters is swallowed: its first
move is that of the next token.
"""

import numpy as np
from jaxtyping import Bool, Int8, Int64

from infgen.tokens.scene_tokens import Presence


def seen_tokens(
    valid: Bool[np.ndarray, "agent border"],
) -> Bool[np.ndarray, "agent border-1"]:
    """Tell the tokens with the agent at both ends, from its validity at token borders."""
    return valid[:, :-1] & valid[:, 1:]


def first_token(seen: Bool[np.ndarray, "agent token"]) -> Int64[np.ndarray, " agent"]:
    """Return the first token seen of each agent; the number of tokens if there is none."""
    return np.where(seen.any(axis=1), seen.argmax(axis=1), seen.shape[1])


def last_token(seen: Bool[np.ndarray, "agent token"]) -> Int64[np.ndarray, " agent"]:
    """Return the last token seen of each agent; -1 if there is none."""
    return seen.shape[1] - 1 - first_token(seen[:, ::-1])


def has_motion(seen: Bool[np.ndarray, "agent token"]) -> Bool[np.ndarray, " agent"]:
    """Tell the agents of whom one token and the next are seen: there is a move to learn."""
    return (seen[:, :-1] & seen[:, 1:]).any(axis=1)


def presence_states(
    seen: Bool[np.ndarray, "agent token"],
) -> Int8[np.ndarray, "agent token"]:
    """Give each agent its presence at each token.

    The end of the log is not an exit: who is seen in the last token stays. A gap is not one
    either: an agent is present throughout its life, seen or not. A life of one token is
    ``INSERTED``, then ``ABSENT``: nobody leaves who has not moved.
    """
    tokens = np.arange(seen.shape[1])
    first, last = first_token(seen)[:, None], last_token(seen)[:, None]
    presence = np.where((first <= tokens) & (tokens <= last), Presence.PRESENT, 0)
    leaving = (tokens == last) & (tokens < seen.shape[1] - 1)
    presence = np.where(leaving, Presence.REMOVED, presence)
    presence = np.where(tokens == first, Presence.INSERTED, presence)
    return presence.astype(np.int8)


def observed_tokens(
    seen: Bool[np.ndarray, "agent token"], presence: Int8[np.ndarray, "agent token"]
) -> Bool[np.ndarray, "agent token"]:
    """Tell the tokens at which an agent's own motion is known: seen, and not entering."""
    return seen & (presence != Presence.INSERTED)


def gap_ends(
    seen: Bool[np.ndarray, "agent token"], presence: Int8[np.ndarray, "agent token"]
) -> Bool[np.ndarray, "agent token"]:
    """Tell the last token of each gap: at its end the agent is back in the log."""
    back = np.zeros_like(seen)
    back[:, :-1] = ~seen[:, :-1] & seen[:, 1:] & (presence[:, :-1] != Presence.ABSENT)
    return back
