"""Damage to checkpoints: to the bytes under a seal that fits, to their content, and code in the place of data."""

import hashlib
import io
import pickle
import zipfile
from random import Random
from typing import Any

import torch

from nerfloom.training.checkpoint import SEAL
from tests.fuzz.payload import Payload
from tests.fuzz.raw import RAW
from tests.fuzz.trees import damaged_tree
from tests.fuzz.values import DEEP, PLAIN

LENGTH = len(SEAL) + 64
TENSORS = (
    torch.zeros(0), torch.zeros(2), torch.zeros(2, 3), torch.full((2, 3), torch.nan), torch.tensor(1e38),
    torch.zeros(2, 3, dtype=torch.int64), torch.eye(3).to_sparse(), torch.zeros(1).expand(10**12),
    torch.zeros(2, dtype=torch.complex64), torch.ones(3, dtype=torch.bool), torch.zeros(4, 4, 4, 4),
)  # fmt: skip
WORDS = ("format", "model", "state", "scene", "optimizer", "errors", "step")
VALUES = (*(value for value in PLAIN if value is not DEEP), *TENSORS, (), (1, 2), b"bytes", {1: 2})


def sealed(content: bytes) -> bytes:
    """Any content with the seal that fits it."""
    return content + SEAL + hashlib.sha256(content).hexdigest().encode()


def written(value: Any) -> bytes:
    file = io.BytesIO()
    torch.save(value, file)
    return sealed(file.getvalue())


def under_the_seal(random: Random, content: bytes) -> bytes:
    return sealed(random.choice(RAW)(random, content[:-LENGTH]))


def other_content(random: Random, content: bytes) -> bytes:
    """A well-formed file with other values."""
    try:
        found = torch.load(io.BytesIO(content), weights_only=True)
    except Exception:  # damaged before
        return under_the_seal(random, content)
    for _ in range(random.choice((1, 1, 2))):
        found, _ = damaged_tree(random, found, WORDS, VALUES)
    return written(found)


def unfolding(random: Random, content: bytes) -> bytes:
    """The same content, but compressed, and with more in it than the file has bytes."""
    packed = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as stored, zipfile.ZipFile(packed, "w") as bomb:
            for name in stored.namelist():
                bomb.writestr(zipfile.ZipInfo(name), stored.read(name), zipfile.ZIP_DEFLATED)  # of no date
            bomb.writestr(zipfile.ZipInfo("archive/data/9"), bytes(2**22), zipfile.ZIP_DEFLATED)
    except Exception:  # damaged before
        return under_the_seal(random, content)
    return sealed(packed.getvalue())


def code(random: Random, content: bytes) -> bytes:
    """Pickles that would run code, in each way that torch has of writing them."""
    evil = {"format": random.choice((1, 2)), "model": Payload()}
    old = io.BytesIO()
    torch.save(evil, old, _use_new_zipfile_serialization=False)
    return random.choice((written(evil), sealed(old.getvalue()), pickle.dumps(evil), sealed(pickle.dumps(evil))))


CHECKPOINT = (
    under_the_seal, under_the_seal, other_content, other_content, other_content, other_content, unfolding, code, *RAW,
)  # fmt: skip
