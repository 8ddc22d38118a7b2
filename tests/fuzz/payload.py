"""What must never happen: code in a file that is run by reading it."""

PROOF = "proof"
"""The file that it would leave in the current folder."""


class Payload:
    """Leaves `PROOF` when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, (f"open({PROOF!r}, 'w').close()",)
