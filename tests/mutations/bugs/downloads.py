"""What is downloaded: whether it is the file, and whether it stays in its folder."""

from tests.mutations.bug import Bug

BUGS = (
    Bug(
        "download-mixes-versions",
        "downloads",
        "framework/downloads/fetch.py",
        "if known.url != source.url or not (known.validator or source.sha256):",
        "if known.url != source.url:",
        "after a break, the rest of a newer file is appended to the part of an older one",
    ),
    Bug(
        "download-of-another-source-goes-on",
        "downloads",
        "framework/downloads/fetch.py",
        "if known.url != source.url or not (known.validator or source.sha256):",
        "if not (known.validator or source.sha256):",
        "the rest of one mirror's file is appended to the part of another's",
    ),
    Bug(
        "truncated-download-counts",
        "downloads",
        "framework/downloads/fetch.py",
        "if total is not None and size < total:",
        "if total is None and size == 0:",
        "a file that was cut off passes where no checksum is stated",
    ),
    Bug(
        "wrong-download-is-kept",
        "downloads",
        "framework/downloads/fetch.py",
        '            part.unlink()\n            raise SourceError(f"{source.url}: the file has',
        '            raise SourceError(f"{source.url}: the file has',
        "a file with a wrong checksum is there at the next call, which finds it complete, and fails again for ever",
    ),
    Bug(
        "archive-leaves-its-folder",
        "downloads",
        "framework/downloads/unpack.py",
        'if part in ("", ".", "..") or UNSAFE.search(part) or len',
        "if len",
        "an archive writes files outside the folder",
    ),
    Bug(
        "archive-with-links",
        "downloads",
        "framework/downloads/unpack.py",
        "if kind not in (0, stat.S_IFREG, stat.S_IFDIR):",
        "if kind in (stat.S_IFIFO,):",
        "links in an archive are taken for files",
    ),
    Bug(
        "archive-without-end",
        "downloads",
        "framework/downloads/unpack.py",
        "if total > MAX_EXPANSION * size + ALLOWANCE:",
        "if total < 0:",
        "a small archive fills the disk",
    ),
    Bug(
        "scene-that-is-there-is-replaced",
        "downloads",
        "framework/downloads/install.py",
        "if scene in chosen and not (folder / scene).exists()]",
        "if scene in chosen]",
        "what somebody changed or added in a scene's folder costs another download, or is lost",
    ),
)
