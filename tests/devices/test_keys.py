"""The table of profile keys: what the page shows is what the reader takes."""

import pytest

from thermoctl.files import yamlfile
from thermoctl.files.yamlfile import InputError, Section
from thermoctl_hal.base.key import REQUIRED, take
from thermoctl_hal.profiles.keys import TABLES

KEYS = [(table, key) for table, keys in TABLES.items() for key in keys]


def section(text):
    return Section(yamlfile.loads(text), "section")


@pytest.mark.parametrize(
    "table,key", [(t, k) for t, k in KEYS if k.example], ids=lambda x: getattr(x, "name", x)
)
def test_every_example_is_read(table, key):
    """With the other required keys given, the example passes the reader."""
    given = {k.name: k.example or "1" for k in TABLES[table] if k.default is REQUIRED} | {
        key.name: key.example
    }
    for k in TABLES[table]:
        if k.name in given and not k.example:
            given[k.name] = {
                "text": (k.choices or ("x",))[0], "list": "[]", "section": "{}", "interval": "[0, 1]",
            }.get(k.kind, f"{max(k.low, 1):g}")  # fmt: skip
    s = section("{" + ", ".join(f"{n}: {v}" for n, v in given.items()) + "}")
    take(s, TABLES[table])
    s.end()


@pytest.mark.parametrize(
    "table,key",
    [(t, k) for t, k in KEYS if k.kind in ("number", "integer")],
    ids=lambda x: getattr(x, "name", x),
)
def test_defaults_lie_inside_their_limits_and_text_is_refused(table, key):
    if key.default is not REQUIRED and key.default:
        assert key.low <= key.default <= key.high
    with pytest.raises(InputError, match=f"{key.name}: a (whole )?number was expected"):
        take(section(f"{{{key.name}: wrong}}"), [key])


def test_every_key_says_what_it_means():
    assert all(len(k.meaning) > 5 for _, k in KEYS) and len(KEYS) > 120
    for table, keys in TABLES.items():
        names = [k.name for k in keys]
        assert len(set(names)) == len(names), table
