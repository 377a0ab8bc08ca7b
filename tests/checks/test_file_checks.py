"""`plant check` without recordings warns of missing units, negative storages, wrong signs and scales that stay open."""

import pytest

from tests.plants import TWO_BLOCKS
from thermoctl import cli
from thermoctl.checks.file import file_findings
from thermoctl.files.shipped import shipped
from thermoctl.plant import load, loads

OPEN = TWO_BLOCKS.replace("rate: heat, unit: W", "rate: P * heat, unit: W").replace(
    "  C_1:", "  P: {value: 1, range: [0.1, 10]}\n  C_1:"
)


def kinds(text):
    return [(f.kind, f.where.rpartition("<text>")[2]) for f in file_findings(loads(text))]


def test_a_good_plant_has_no_finding():
    assert kinds(TWO_BLOCKS) == []
    for path in (shipped("config/plants/templates")).glob("*.yaml"):
        assert file_findings(load(path)) == [], path.name


@pytest.mark.parametrize(
    ("old", "new", "kind", "where"),
    [
        ("C_1, initial", "-C_1, initial", "storage", ":13:8"),
        ("from: one, rate: G_1", "into: one, rate: G_1", "sign", ":18:11"),
        ("rate: G_2 * (two - air)", "rate: G_2 * (air - two)", "sign", ":19:11"),
    ],
)
def test_a_wrong_sign_is_named_with_its_place(old, new, kind, where):
    assert old in TWO_BLOCKS
    assert (kind, where) in kinds(TWO_BLOCKS.replace(old, new))


def test_a_scale_that_no_recording_gives():
    (finding,) = file_findings(loads(OPEN))
    assert finding.kind == "scale" and "ratios of C_1, C_2, G_1, G_12, G_2, P:" in finding.what
    later = OPEN.replace(
        "rate: G_2 * (two - air)", "rate: G_2 * (two - air) * (1 + A * step(t - T0))"
    ).replace(
        "  C_1:",
        "  A: {value: -0.3, range: [-0.9, 3]}\n  T0: {value: 900, unit: s, range: [0, 3600]}\n  C_1:",
        1,
    )
    assert [f.what for f in file_findings(loads(later))] == [
        finding.what
    ]  # a step that comes later has no scale
    fixed = OPEN.replace("P: {value: 1, range: [0.1, 10]}", "P: {value: 1}")
    assert file_findings(loads(fixed)) == []


def test_the_command_prints_it_and_is_still_good(tmp_path, capsys):
    (tmp_path / "p.yaml").write_text("format: thermoctl-plant/1\noutputs: {y: {value: 1}}\n")
    assert cli.main(["plant", "check", str(tmp_path / "p.yaml")]) == 0
    assert "warning: " in (out := capsys.readouterr().out) and "no quantity has a unit" in out
