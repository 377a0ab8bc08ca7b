"""No docstring or comment has a mechanical fault of language."""

import pytest

from tests.language import ROOT, Text, counts, texts


def test_no_package_has_faults():
    found = {package: n for package, n in counts().items() if n}
    assert not found, f"{found}; `python -m tests.language --all` shows each fault"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("Return " + "one word " * 13 + ".", "27 words in one sentence"),
        ("Hold the gain. What the filter expects is in q.", "name the thing"),
        ("Two explanations fit.", "'explanations': hypothesis"),
        ("of a recording, at most", "name the quantity first"),
        ("Return the gain, K.", None),
        ("What is the gain?", None),
        ("Return the gain.\n\n    " + "x = y + " * 30 + "z", None),  # an equation
        ("Return `explanation`.", None),
    ],
)
def test_each_rule(text, fault):
    found = Text(ROOT / "thermoctl/cli/__init__.py", 1, text, 80).faults()
    assert not found if fault is None else [f for f in found if fault in f], found


def test_every_docstring_and_block_of_comments_is_read(tmp_path):
    source = tmp_path / "x.py"
    source.write_text(
        '"""Module."""\n# one\n# two\nx = 1  # three\ny = "no docstring"\n'
        'def f():\n    """Return 1.\n\n    More."""\n    # four: '
        + "a" * 110
        + "\n    return 1  # noqa: E501\n"
    )
    found = [(t.line, t.text.strip()[:7], bool(t.faults())) for t in texts(source)]
    assert found == [
        (1, "Module.", False),
        (2, "one\ntwo", False),
        (4, "three", False),
        (7, "Return ", False),
        (10, "four: a", True),
    ]
