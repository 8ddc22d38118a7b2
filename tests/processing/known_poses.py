"""COLMAP, if it found the truth at once."""

import pytest

from nerfloom.processing import features, mapping, matching
from nerfloom.processing import reconstruction as module
from nerfloom.processing.reconstruction import Reconstruction
from tests.dataparsers.sparse_models import Capture, write_colmap


def without_colmap(monkeypatch: pytest.MonkeyPatch, camera: str, capture: Capture) -> None:
    """Let `ns-process-data` find poses, names and points of `capture`, and the lens of COLMAP's line `camera`."""

    def extract(state: Reconstruction, *_: object) -> None:
        state.database.touch()

    def reconstruct(state: Reconstruction, *_: object) -> list[int]:
        write_colmap(state.work / "sparse" / "0", capture, camera)
        return [len(capture.names)]

    monkeypatch.setattr(features, "extract", extract)
    monkeypatch.setattr(matching, "choose_pairs", lambda *_: [])
    monkeypatch.setattr(matching, "match", lambda *_: None)
    monkeypatch.setattr(mapping, "reconstruct", reconstruct)
    monkeypatch.setattr(module, "run_in_child", lambda work, arguments, *_: work(None, *arguments))
