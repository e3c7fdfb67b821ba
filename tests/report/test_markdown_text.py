"""Text that somebody else wrote, in the Markdown of a report: no HTML, no link, no picture."""

from __future__ import annotations

import pytest

from wasp_cli.report.render import markdown_text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("the robot starts within a hazard", "the robot starts within a hazard"),
        ("<script>x()</script>", "&lt;script>x()&lt;/script>"),
        ("a &lt; b", "a &amp;lt; b"),
        ("![p](http://there/p.png)", r"!\[p\](http://there/p.png)"),
        (r"\[a](b)", r"\\\[a\](b)"),
        ("Preset `cpu`", "Preset `cpu`"),
    ],
)
def test_it_stays_text(text: str, expected: str) -> None:
    assert markdown_text(text) == expected
