"""Presence of agents at each token step, from their logged validity (SPEC 3.3).

A token is *seen* if the log shows the agent at both its ends. An agent is
inserted at its first seen token and removed at its last one. Its motion during the first
token is not encoded: its first motion token is that of the next token step.
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
    """Tell which agents are seen in two tokens in a row, so have motion to learn."""
    return (seen[:, :-1] & seen[:, 1:]).any(axis=1)


def presence_states(
    seen: Bool[np.ndarray, "agent token"],
) -> Int8[np.ndarray, "agent token"]:
    """Return the ``Presence`` of each agent at each token step.

    An agent seen in the last token of the log is not removed. A gap does not end presence:
    an agent is present from its first to its last seen token. An agent seen in one token
    only is ``INSERTED``, then ``ABSENT``.
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
    """Tell the tokens whose motion is known: seen, and not the insertion."""
    return seen & (presence != Presence.INSERTED)


def gap_ends(
    seen: Bool[np.ndarray, "agent token"], presence: Int8[np.ndarray, "agent token"]
) -> Bool[np.ndarray, "agent token"]:
    """Tell the last token of each gap: at its end the agent is valid again."""
    back = np.zeros_like(seen)
    back[:, :-1] = ~seen[:, :-1] & seen[:, 1:] & (presence[:, :-1] != Presence.ABSENT)
    return back
