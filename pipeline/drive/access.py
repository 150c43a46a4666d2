"""Who may talk to the server: this machine's browser, with the token of the address."""

import secrets
from dataclasses import dataclass

LOOPBACK = "127.0.0.1"
"""The only address the server listens at."""
TOKEN_BYTES = 24
MESSAGES_PER_S, MOST_AT_ONCE = 120.0, 240.0
"""A page sends far fewer messages."""


@dataclass(frozen=True, slots=True)
class Access:
    """The rules of one server.

    Attributes:
        port: Where it listens.
        token: First part of every path.
    """

    port: int
    token: str

    @classmethod
    def at(cls, port: int) -> "Access":
        """Make rules with a fresh token."""
        return cls(port, secrets.token_urlsafe(TOKEN_BYTES))

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self.port}/{self.token}/"

    @property
    def policy(self) -> str:
        """What the page may load: its own files and nothing else."""
        lines = " ".join(f"ws://{host}" for host in self._hosts)
        return (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
            f"connect-src {lines}; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )

    def refusal(
        self, host: str, origin: str | None, token: str, *, needs_origin: bool
    ) -> str | None:
        """Return why a request is refused; None if it is not.

        Args:
            host: Header ``Host``. Another name that leads to this machine is refused: so
                would a foreign page look to the browser (DNS rebinding).
            origin: Header ``Origin`` of the page that asks, where there is one.
            token: First part of the path.
            needs_origin: Whether a browser always names the origin (of a websocket).
        """
        if host not in self._hosts:
            return f"host {host!r}, expected {self._hosts[0]}"
        if origin is None and needs_origin:
            return "no origin, expected that of the page"
        if origin is not None and origin not in [f"http://{name}" for name in self._hosts]:
            return f"origin {origin!r}, expected http://{self._hosts[0]}"
        if not secrets.compare_digest(token.encode(), self.token.encode()):
            return "no or another token"
        return None

    @property
    def _hosts(self) -> tuple[str, str]:
        return f"{LOOPBACK}:{self.port}", f"localhost:{self.port}"


class MessageRate:
    """Counts messages: a page may send some at once, and so many in a second."""

    def __init__(self, now_s: float) -> None:
        self._left, self._at_s = MOST_AT_ONCE, now_s

    def allows(self, now_s: float) -> bool:
        """Whether one more message is allowed now."""
        more = MESSAGES_PER_S * (now_s - self._at_s)
        self._left, self._at_s = min(MOST_AT_ONCE, self._left + more) - 1, now_s
        return self._left >= 0
