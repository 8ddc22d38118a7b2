"""Tables in files: the same values as in memory after every change, and nothing left on the disk."""

import errno
import os
from pathlib import Path

import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.base.optimised import RowChange
from nerfloom.kernels import mapped_tables
from nerfloom.kernels.mapped_tables import MappedTables
from nerfloom.kernels.table_memory import IN_MEMORY

KEPT = torch.tensor([5, 0, 3, 6])


@pytest.mark.parametrize("shape", [(7, 3), (7,), (7, 0)])
@pytest.mark.parametrize("added", [0, 3])
@pytest.mark.parametrize("sorted_again", [False, True])
def test_a_change_is_that_of_a_table_in_memory(
    shape: tuple[int, ...], added: int, sorted_again: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mapped_tables, "PIECE", 3)
    tables, values = MappedTables(tmp_path), torch.randn(shape)
    fresh = torch.randn(added, *shape[1:])
    order = torch.randperm(len(KEPT) + added, generator=torch.Generator().manual_seed(0)) if sorted_again else None
    change = RowChange(torch.nn.Parameter(values.clone()), KEPT, fresh if added else None, order)
    mapped = tables.kept(values)
    assert torch.equal(mapped, values)
    assert torch.equal(tables.copied(values.double(), values), IN_MEMORY.copied(values.double(), values))
    for new in (fresh, None):
        found, expected = tables.changed(mapped, change, new), IN_MEMORY.changed(values, change, new)
        assert found.dtype == expected.dtype
        assert torch.equal(found, expected)
    kept_rows = torch.cat([values[KEPT], fresh])
    assert torch.equal(tables.changed(mapped, change, fresh), kept_rows if order is None else kept_rows[order])


def test_released_rows_keep_their_values_and_files_have_no_names(tmp_path: Path) -> None:
    tables, like = MappedTables(tmp_path / "cache"), torch.zeros(1)
    table = tables.zeros(5000, 4, like=like)
    assert not table.any()
    table[:] = torch.arange(20_000.0).view(5000, 4)
    tables.release()
    assert torch.equal(table, torch.arange(20_000.0).view(5000, 4))
    table[17] = -1.0
    tables.release()
    expected = torch.arange(20_000.0).view(5000, 4)
    expected[17] = -1.0
    assert torch.equal(table, expected)
    assert list((tmp_path / "cache").iterdir()) == []
    assert len(tables._maps) == 1
    del table
    assert len(tables._maps) == 0


def test_a_full_disk_is_said_before_a_table_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(ConfigError, match=r"--memory-limit: cannot keep a table of 4 MB .*choose another --cache-dir"):
        MappedTables(tmp_path).zeros(10**6, like=torch.zeros(1))
    assert list(tmp_path.iterdir()) == []
