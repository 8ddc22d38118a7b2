"""Damage to numpy's files: a header with false claims, unwanted kinds of values, and pickles."""

import ast
import io
import math
import pickle
import struct
import zipfile
from random import Random

import numpy as np

from tests.fuzz.payload import Payload
from tests.fuzz.raw import RAW

SHAPES = (
    "()", "(0,)", "(1,)", "(0, 17)", "(5,)", "(17, 5)", "(5, 17, 1)", "(5, -17)", "(-1, 17)", "(10000000000, 17)",
    "(4611686018427387904, 17)", "(2147483648, 2147483648)", "17", "(5.0, 17)", "(5, 17", "'x'",
)  # fmt: skip
KINDS = (
    "'<f4'", "'>f8'", "'<f2'", "'<i8'", "'|u1'", "'|b1'", "'<c16'", "'<U9'", "'|S4'", "'|O'", "'|V1000000000'",
    "'<M8[s]'", "[('a', '<f8'), ('b', '<f8')]", "'nothing'", "7", "''",
)  # fmt: skip
MAGIC = b"\x93NUMPY"


def other_shape(random: Random, content: bytes) -> bytes:
    return _with_header(content, shape=random.choice(SHAPES))


def other_kind(random: Random, content: bytes) -> bytes:
    return _with_header(content, descr=random.choice(KINDS))


def other_order(random: Random, content: bytes) -> bytes:
    return _with_header(content, fortran_order=random.choice(("True", "3", "None", "")))


def other_version(random: Random, content: bytes) -> bytes:
    return MAGIC + bytes(random.choice(((2, 0), (3, 0), (9, 9), (0, 0)))) + content[8:]


def long_header(random: Random, content: bytes) -> bytes:
    length = random.choice((0, 1, 65535))
    return content[:8] + struct.pack("<H", length) + random.choice((b" ", b"(", b"{", b"-")) * length + content[10:]


def pickled(random: Random, content: bytes) -> bytes:
    """An array of objects, which would run code if it were read."""
    file = io.BytesIO()
    np.save(file, np.array([Payload()], dtype=object), allow_pickle=True)
    return random.choice((file.getvalue(), pickle.dumps(Payload()), pickle.dumps(np.zeros((5, 17)))))


def archive(random: Random, content: bytes) -> bytes:
    """Several arrays under one name, one of them pickled."""
    file = io.BytesIO()
    np.savez(file, a=np.zeros((5, 17)), b=np.array([Payload()], dtype=object))
    return file.getvalue()


def _with_header(content: bytes, **entries: str) -> bytes:
    """An array's file with other entries in its header, as they are written; as it was if it has no header."""
    try:
        length = struct.unpack("<H", content[8:10])[0]
        known = {key: repr(value) for key, value in ast.literal_eval(content[10 : 10 + length].decode()).items()}
    except (struct.error, ValueError, TypeError, SyntaxError, AttributeError, RecursionError, MemoryError):
        return content
    text = "{" + ", ".join(f"'{key}': {value}" for key, value in {**known, **entries}.items()) + "}"
    header = text[:60_000].ljust(length - 1).encode() + b"\n"
    return content[:8] + struct.pack("<H", len(header) % 2**16) + header + content[10 + length :]


ARRAY = (
    other_shape, other_shape, other_kind, other_kind, other_order, other_version, long_header, pickled, archive, *RAW,
)  # fmt: skip


def entry(random: Random, content: bytes) -> bytes:
    """An archive of arrays; one is damaged, or is another's."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # damaged before
        return random.choice(RAW)(random, content)
    name = random.choice(sorted(entries))
    what = random.random()
    if what < 0.2 and len(entries) > 1:
        entries[random.choice(sorted(entries))] = entries.pop(name)
    elif what < 0.5:
        entries[name] = other_numbers(random, entries[name])
    else:
        entries[name] = random.choice(ARRAY)(random, entries[name])
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, held in entries.items():
            archive.writestr(zipfile.ZipInfo(name), held)
    return file.getvalue()


def other_numbers(random: Random, content: bytes) -> bytes:
    """Some of the last values of an array of float64 are others."""
    values = bytearray(content)
    for _ in range(random.choice((1, 1, 3, 16))):
        start = len(values) - 8 * random.randrange(1, 17)
        if start >= 0:
            number = random.choice((0.0, -1.0, 1e-300, 1e300, -1e18, 1e5, math.nan, math.inf, 0.5))
            struct.pack_into("<d", values, start, number)
    return bytes(values)


ARCHIVE = (entry, entry, entry, archive, *RAW[:2])
