"""No proxy stands before the loopback, and nobody waits between attempts."""

import pytest

from nerfloom.downloads import fetch


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(fetch, "PAUSES", (0.0, 0.0))
    monkeypatch.setattr(fetch, "TIMEOUT", 5.0)
