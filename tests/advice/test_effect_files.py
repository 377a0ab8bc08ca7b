"""`thermoctl effects check` names each mistake with its place; docs/reference/effect-files.md says what the code says."""

import re
from pathlib import Path

import pytest

from thermoctl import cli
from thermoctl.advice.effect_files import check_file
from thermoctl.diagnosis.hypothesis.catalogue import catalogue
from thermoctl.diagnosis.hypothesis.effect import FORMS, PARTS, SHAPES, SYMBOLS
from thermoctl.diagnosis.hypothesis.places import PLACES
from thermoctl.files.shipped import shipped
from thermoctl.files.yamlfile import Section
from thermoctl.plant import load

PAGE = (Path(__file__).parents[2] / "docs/reference/effect-files.md").read_text()
WORKED = re.search(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[1]


def chapter(title):
    return re.split(r"^## ", PAGE.split(f"\n## {title}\n")[1], flags=re.MULTILINE)[0]


def rows(title):
    return [
        [re.findall(r"`(\w+)`", cell) for cell in line.split("|")[1:-1]]
        for line in chapter(title).splitlines()
        if line.startswith("| `")
    ]


def test_the_page_lists_what_the_reader_knows():
    assert {r[0][0]: tuple(r[2]) for r in rows("Places") if r[0] != ["where"]} == dict(SYMBOLS)
    assert set(SYMBOLS) == set(PLACES)
    assert {r[0][0] for r in rows("Changes")} == {*FORMS, *PARTS, "exponent", "straight", "recorded"}
    told = {kind: r[1] for r in rows("Shapes") for kind in r[0]}
    assert set(told) == set(SHAPES)
    assert all(set(SHAPES[kind]) <= set(names) for kind, names in told.items())


def test_every_key_that_the_check_asks_for_is_in_the_table(monkeypatch):
    asked, shapes = set(), catalogue()["second_ambient"].shapes
    get = Section.get
    monkeypatch.setattr(
        Section, "get", lambda self, key, required=True: asked.add(key) or get(self, key, required)
    )
    check_file(shipped("config/effects") / "second_ambient.yaml", [])
    table = {
        k
        for _, cell in re.findall(r"^\| (\w+) \| (`.*?`) \|", chapter("Keys"), re.MULTILINE)
        for k in re.findall(r"`(\w+)`", cell)
    }
    assert asked - {"from", "into", "rate", *shapes} - {"G", *(f"B{k}" for k in range(5))} == table


def test_the_worked_effect_and_its_mistake_print_as_on_the_page(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("bearings").mkdir()
    Path("bearings/bearing_heat.yaml").write_text(WORKED)
    assert cli.main(["effects", "check", "bearings/bearing_heat.yaml"]) == 0
    assert f"\n{capsys.readouterr().out}" in PAGE
    Path("bearings/bearing_heat.yaml").write_text(WORKED.replace("abs(v)", "abs(V)"))
    assert cli.main(["effects", "check", "bearings"]) == 1
    assert f"\n{capsys.readouterr().err.removeprefix('thermoctl: ')}" in PAGE


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("into: T", "from: temp", r":6:18: flow: 'temp' is not a node of the place; T was expected"),
        ("into: T, ", "", r":6:11: flow: 'from' or 'into' was expected"),
        ("low: 0", "low: zero", r":7:\d+: low of 'K'|:7:\d+: low: a number was expected, found 'zero'"),
        ("needs: [v]", "needs: [w]", r":4:9: needs: one of x, v, i, T was expected, found 'w'"),
        (
            "where: temperature_node",
            "where: temperature_nod",
            r":3:8: where: 'temperature_nod' is not one of .*did you mean 'temperature_node'",
        ),
        (
            "W/(unit_of_v)",
            "W",
            r":6:3: at temperature_node 'coil' of .*actuator.yaml.*is \[kg m3 s-4\], but its place asks",
        ),
        ("K * abs", "AMB * abs", r":6:27: rate of flow: 'AMB' is not known here; allowed are K, T, air"),
        ("exp(-(T", "exp(-((T", r":6:27: rate of flow: '\)' was expected"),
        ("flow:", "flows:", r":6:\d+: 'flows' is not a change \(did you mean 'flow'\?\)"),
        ("mimics", "mimic", r":9:8: an effect file: unknown key 'mimic' \(did you mean 'mimics'\?\)"),
        (
            "low: 0}",
            "low: 0, shape: tau}",
            r":7:\d+: parameter 'K': shape 'tau' is none of this effect's shapes \(none\)",
        ),
        ("low: 0}", "low: 0, trial: s3 * q}", r":7:\d+: trial of 'K': 'q' is not known here"),
        (
            "W/(unit_of_v)",
            "W/(unit_of_w)",
            r":7:\d+: parameter 'K': no unit 'unit_of_w' .*; there are unit_of_y, .*unit_of_T",
        ),
    ],
)
def test_a_mistake_is_one_line_with_its_place(old, new, expected, tmp_path, capsys):
    assert old in WORKED
    (tmp_path / "e.yaml").write_text(WORKED.replace(old, new))
    assert cli.main(["effects", "check", str(tmp_path / "e.yaml")]) == 1
    err = capsys.readouterr().err
    assert re.search(expected, err), err
    assert err.count("\n") == 1


def test_the_shipped_catalogue_is_good():
    plants = [load(shipped("config/plants/templates") / f"{n}.yaml") for n in ("tank", "flexure", "motor")]
    for path in shipped("config/effects").glob("*.yaml"):
        assert check_file(path, plants)[0] == path.stem
