"""Lines of the site's pages do not break within a short flag, nor between a number and its unit."""

import html
import re
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.site.pages import ROOT

SPACE = "\N{NO-BREAK SPACE}"
PIECES = [
    *("<code>", "</code>", "<pre>", "</pre>", "<td>", " ", "\n"),
    *("--max-seconds", "a-b", "3 s", "± 1 dB", "&lt;x-y&gt;"),
]


@pytest.fixture(scope="module")
def lines() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "building"))
        import lines as module
    return module


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("<code>ns-train x --max-seconds 15</code>", "<code>{ns-train} x {--max-seconds} 15</code>"),
        ("<code>lego-gaussian-splatting-30s.json</code>", "<code>lego-gaussian-splatting-30s.json</code>"),
        ("<code>--num-proposal-samples</code>", "<code>{--num}-proposal-samples</code>"),
        ("<code>a_b c</code> and nerf-plus-plus", "<code>a_b c</code> and nerf-plus-plus"),
        ("<code>--data&lt;12345678-&gt;</code>", "<code>{--data&lt;12345678-&gt;}</code>"),
        ("<pre><span></span><code>a-b 3 s\n</code></pre>", "<pre><span></span><code>a-b 3 s\n</code></pre>"),
        ("<pre><code>a-b</code>c-d</pre><code>e-f</code>", "<pre><code>a-b</code>c-d</pre><code>{e-f}</code>"),
        ("<td>27.60 ± 0.25 dB</td><td>30 s, 10 %</td>", "<td>27.60 ±_0.25_dB</td><td>30_s, 10_%</td>"),
        ("<code>sleep 30 s</code> 3 steps, 2 s/image", "<code>sleep 30 s</code> 3 steps, 2 s/image"),
        ('<img alt="3 s a-b">', '<img alt="3 s a-b">'),
    ],
)  # fmt: skip
def test_what_is_kept_together(lines: ModuleType, before: str, after: str) -> None:
    """{word} in the expected text stands for a word kept whole, and 3_s for an unbreakable space."""
    expected = re.sub(r"\{(.*?)\}", r'<span class="whole">\1</span>', after)
    assert lines.keep_together(before) == re.sub(r"(?<=[\d±])_", SPACE, expected)


@given(st.lists(st.sampled_from(PIECES), max_size=20))
def test_what_is_shown_stays_the_same(lines: ModuleType, pieces: list[str]) -> None:
    def shown(content: str) -> str:
        return html.unescape(re.sub(r"<[^>]*>", "", content)).replace(SPACE, " ")

    content = "".join(pieces)
    assert shown(lines.keep_together(content)) == shown(content)
