"""Code in a file that reading would run: this must never happen."""

PROOF = "proof"
"""The file that it would leave in the current folder."""


class Payload:
    """Leaves `PROOF` when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, (f"open({PROOF!r}, 'w').close()",)
