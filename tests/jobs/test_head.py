"""The head of a Ray cluster, as a port that accepts connections or does not; Ray is not needed."""

import socket

import pytest

from nerfloom.base.errors import LostProcessError
from nerfloom.jobs import head


def test_a_head_may_be_away_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1000.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        one = head.Head(f"127.0.0.1:{port}")
        assert one.answers()
    clock[0] += 10 * head.AWAY  # while nobody looked
    assert not one.answers()
    clock[0] += head.AWAY - 1
    assert not one.answers()
    with socket.create_server(("127.0.0.1", port)):
        assert one.answers()
    for seconds in (0, head.AWAY - 1):
        clock[0] += seconds
        assert not one.answers()
    clock[0] += 1
    with pytest.raises(LostProcessError, match=rf"^the head of the Ray cluster, 127\.0\.0\.1:{port}, is lost: "):
        one.answers()


def test_an_address_of_six(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def refused(address: tuple[str, int], timeout: float) -> socket.socket:
        asked.append(address)
        raise ConnectionRefusedError

    monkeypatch.setattr(socket, "create_connection", refused)
    assert not head.Head("[::1]:6379").answers()
    assert asked == [("::1", 6379)]
