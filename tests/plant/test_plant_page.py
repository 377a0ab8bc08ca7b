"""docs/reference/plant.md lists every key that the reader asks for, every function and every role; its example runs."""

import re
from pathlib import Path

from thermoctl import cli
from thermoctl.files.yamlfile import Section
from thermoctl.plant import expression as ex
from thermoctl.plant import load, loads
from thermoctl.plant.language import ROLES

PAGE = (Path(__file__).parents[2] / "docs/reference/plant.md").read_text()


def block(kind):
    return re.search(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL)[1]


def chapter(title):
    return re.split(r"^## ", PAGE.split(f"\n## {title}\n")[1], flags=re.MULTILINE)[0]


def test_every_key_that_the_reader_asks_for_is_in_the_table(monkeypatch):
    asked = set()
    get = Section.get

    def listen(self, key, required=True):
        section = "noise" if self.what.startswith("noise") else self.what.split(" '")[0]
        asked.add((section.replace("a plant file", "file"), key))
        return get(self, key, required)

    monkeypatch.setattr(Section, "get", listen)
    loads(block("yaml"))
    loads("format: thermoctl-plant/1\noutputs: {y: {value: 1, noise: {white: 1, flicker: 1}}}")
    loads(
        "format: thermoctl-plant/1\nparameters: {k: {value: 1, per_recording: true, values: {r: 2}}}\noutputs: {y: {value: k}}"
    )
    rows = re.findall(r"^\| (\w+) \| (`.*?`) \|", chapter("Keys"), re.MULTILINE)
    assert {(section, key) for section, keys in rows for key in re.findall(r"`(\w+)`", keys)} == asked


def test_every_function_operator_and_role_is_there():
    rows = re.findall(r"^\| (`.*?`) \|", chapter("Expressions"), re.MULTILINE)
    assert {f for row in rows for f in re.findall(r"`(\w+)`", row)} == {*ex.FUNCTIONS, *ex.SPECIAL}
    assert " ".join(ex.COMPARISONS) in chapter("Expressions")
    assert re.findall(r"`(\w+)`", chapter("Roles")) == list(ROLES)


def test_the_worked_rig_is_checked_and_simulated_as_the_page_prints(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    Path("cooled.yaml").write_text(block("yaml"))
    Path("cooled.csv").write_text(block("csv"))
    assert cli.main(["plant", "check", "cooled.yaml"]) == 0
    assert cli.main(["simulate", "--plant", "cooled.yaml", "cooled.csv"]) == 0
    printed = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert printed == [line for line in block("text").splitlines() if not line.startswith("$")]
    Path("cooled.yaml").write_text(block("yaml").replace("(block - air), unit", "(blok - air), unit"))
    assert cli.main(["plant", "check", "cooled.yaml"]) == 2
    assert f"\n{capsys.readouterr().err.removeprefix('thermoctl: ').strip()}\n" in PAGE
    assert load(Path(__file__).parents[2] / "docs/examples/heater/plant.yaml")
