"""The package's description: every dependency with its licence in install.md, as the package itself states it."""

import importlib
import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OURS = ("test", "all", "docs", "fuzz", "bench")  # for developers, or made of the others
NEEDS = {
    re.match(r"[\w.-]+", need)[0]: extra
    for extra, needs in {"": PROJECT["dependencies"], **PROJECT["optional-dependencies"]}.items()
    if extra not in OURS
    for need in needs
}
TABLE = {
    name: (extra, licence)
    for name, extra, licence in re.findall(
        r"^\| ([\w.-]+) \| (\w*) ?\| (\S.*) \|$", (ROOT / "docs/how-to/install.md").read_text(), re.MULTILINE
    )
}
FAMILIES = {
    "LGPL": "LGPL|Lesser General",
    "MPL": "MPL|Mozilla",
    "BSD": "BSD",
    "MIT": "MIT",
    "Apache": "Apache",
    "PSF": "Python Software|PSF",
}


def test_every_dependency_has_a_row():
    assert {name: TABLE.get(name, ("?",))[0] for name in NEEDS} == NEEDS and not set(TABLE) - {
        *NEEDS,
        "package",
    }


@pytest.mark.parametrize("name", NEEDS)
def test_the_licence_is_the_one_that_the_package_states(name):
    try:
        stated = importlib.metadata.metadata(name)
    except importlib.metadata.PackageNotFoundError:
        pytest.skip(f"{name} is not installed")
    words = [
        stated.get("License-Expression"),
        (stated.get("License") or "")[:100],
        *(stated.get_all("Classifier") or []),
    ]
    text = " ".join(w for w in words if w and (not w.count("::") or w.startswith("License")))
    if not text:
        pytest.skip(f"{name} states its licence in a file only")
    families = [f for f in FAMILIES if f in TABLE[name][1]]
    assert families and any(re.search(FAMILIES[f], text) for f in families), (TABLE[name], text)


def test_the_description_says_whose_and_for_which_python():
    assert PROJECT["authors"] and PROJECT["keywords"]
    assert {f"Programming Language :: Python :: 3.{k}" for k in (11, 12, 13)} <= set(PROJECT["classifiers"])


def test_the_version_stands_in_one_place_and_heads_the_changelog():
    version = importlib.import_module("thermoctl").__version__
    assert "version" in PROJECT["dynamic"] and "version" not in PROJECT
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest and newest[1] == version
