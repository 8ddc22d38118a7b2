"""Programs that are forked end as they would in a process from its start."""

import signal

import pytest

from tests.forked import Forks


def test_what_they_say_and_how_they_end(forks: Forks, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NERFLOOM_SAID", "here")
    code = "import os, sys; print(sys.argv[1:], os.environ['NERFLOOM_SAID'], os.environ['ASKED'])"
    done = forks.run(code, "a b", 3, ASKED="there")
    assert (done.returncode, done.stdout, done.stderr) == (0, "['a b', '3'] here there\n", "")
    ends = {
        "sys.exit(7)": 7, "sys.exit('no')": 1, "sys.exit()": 0, "1 / 0": 1,
        "os.kill(os.getpid(), 9)": -signal.SIGKILL,
    }  # fmt: skip
    found = forks.together(*((f"import os, sys; {code}", (), {}) for code in ends))
    assert [each.returncode for each in found] == list(ends.values())
    assert found[3].stderr.endswith("ZeroDivisionError: division by zero\n")


def test_they_know_nothing_of_each_other_but_torch(forks: Forks) -> None:
    code = "import sys; print('torch' in sys.modules, 'nerfloom.model' in sys.modules, 'tests.conftest' in sys.modules)"
    assert forks.run("import nerfloom.kernels.native").returncode == 0
    assert forks.run(code).stdout.split() == ["True", "False", "False"]
