"""A plugin written for the old interface is refused with one line that refers to the needed change."""

from pathlib import Path

import pytest

from nerfloom import registry
from tests.cli.helpers import called

WHERE = "docs/plugins.md, 'Plugins for an older interface', says what to change"
OLD = {
    "an old module": "from framework.renderers import render_field\n",
    "an old name": "from framework import Batch\n",
    "an old declaration": (
        "from framework import Method, Model, TrainConfig\n"
        "METHOD = Method(Model, TrainConfig(), paper='none', interface=1)\n"
    ),
    "an old number": (
        "from nerfloom import Method, TrainConfig\nMETHOD = Method(TrainConfig(), paper='none', interface=2)\n"
    ),
}


@pytest.mark.parametrize("what", OLD)
def test_one_line_says_what_to_change(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = f"old_{list(OLD).index(what)}"
    (tmp_path / f"{module}.py").write_text(OLD[what])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("NERFLOOM_METHODS", f"old={module}:METHOD")
    registry.registered.cache_clear()
    done = called("ns-train", "old")
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("error: method 'old' of NERFLOOM_METHODS")
    assert line.endswith(WHERE)


def test_the_documents_say_it() -> None:
    assert "### Plugins for an older interface" in (Path(__file__).parents[2] / "docs" / "plugins.md").read_text()
