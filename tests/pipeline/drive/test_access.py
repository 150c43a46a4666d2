import pytest

from pipeline.drive.access import MESSAGES_PER_S, MOST_AT_ONCE, Access, MessageRate

ACCESS = Access(8123, "right-token")
HERE = "127.0.0.1:8123"


def refusal(host=HERE, origin=f"http://{HERE}", token="right-token", needs_origin=True):
    return ACCESS.refusal(host, origin, token, needs_origin=needs_origin)


@pytest.mark.parametrize("host", [HERE, "localhost:8123"])
def test_the_page_itself_is_let_in(host):
    assert refusal(host, f"http://{host}") is None
    assert refusal(host, None, needs_origin=False) is None


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"host": "evil.example:8123"}, "host 'evil.example:8123'"),
        ({"host": "127.0.0.1"}, "host"),
        ({"host": "127.0.0.1:8124"}, "host"),
        ({"host": ""}, "host"),
        ({"origin": "http://evil.example"}, "origin 'http://evil.example'"),
        ({"origin": "null"}, "origin"),
        ({"origin": f"https://{HERE}"}, "origin"),
        ({"origin": "http://127.0.0.1:8124"}, "origin"),
        ({"origin": "http://evil.example", "needs_origin": False}, "origin"),
        ({"origin": None}, "no origin"),
        ({"token": ""}, "token"),
        ({"token": "right-toke"}, "token"),
        ({"token": "wröng"}, "token"),
    ],
)
def test_others_are_refused(asked, why):
    assert why in refusal(**asked)


def test_tokens_are_long_and_new_each_time():
    tokens = {Access.at(1).token for _ in range(50)}

    assert len(tokens) == 50
    assert min(map(len, tokens)) >= 32


def test_a_refusal_does_not_tell_the_token():
    assert "right-token" not in refusal(token="x")


def test_a_page_may_send_some_at_once_and_so_many_in_a_second():
    rate = MessageRate(0.0)

    assert all(rate.allows(0.0) for _ in range(int(MOST_AT_ONCE)))
    assert not rate.allows(0.0)
    assert rate.allows(2.5 / MESSAGES_PER_S)


def test_a_page_that_keeps_to_the_rate_is_never_refused():
    rate = MessageRate(0.0)

    assert all(rate.allows(at / MESSAGES_PER_S) for at in range(5000))
