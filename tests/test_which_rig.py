"""One rule by which every command finds its configuration, and says which file it took."""

import pytest

from thermoctl import cli
from thermoctl.cli import command_line
from thermoctl.configuration import which_rig
from thermoctl.files.shipped import COPIED, shipped
from thermoctl.files.yamlfile import InputError

COMMANDS = {  # every command that means a rig, as it would be typed without --config
    "run": [],
    "demo": [],
    "start": [],
    "stop": [],
    "restart": [],
    "status": [],
    "arm": [],
    "disarm": [],
    "reload": [],
    "setpoint": ["5"],
    "check": [],
    "doctor": [],
    "latency": [],
    "virtual-rig": [],
    "service": ["install"],
    "dashboard": ["--commands"],
    "monitor": [],
    "mqtt": ["--broker", "b"],
    "tune": [],
    "experiment": ["test_1"],
    "identify": ["a", "b", "c"],
    "calibrate": [],
    "diagnose": ["--resolve", "--plant", "p", "--out", "o"],
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to stand in, and no configuration named."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("THERMOCTL_CONFIG", raising=False)
    monkeypatch.setattr(which_rig, "FALLBACKS", ("config/simulated.yaml", str(tmp_path / "etc/rig.yaml")))
    return tmp_path


def parsed(command, *more):
    return command_line.parser().parse_args([command, *COMMANDS[command], *more])


@pytest.mark.parametrize("command", COMMANDS)
def test_one_order_for_every_command(command, folder, monkeypatch, capsys):
    if command == "demo":  # it has a rig of its own
        demo = parsed(command)
        which_rig.choose(demo)
        assert demo.config == str(shipped("config") / "simulated.yaml")
        capsys.readouterr()
    else:
        with pytest.raises(InputError, match="no configuration: neither config/simulated.yaml"):
            which_rig.choose(parsed(command))
    for name in ("etc", "config"):
        (folder / name).mkdir()
    found = []

    def chosen(*more):
        args = parsed(command, *more)
        which_rig.choose(args)
        found.append(args.config)
        return capsys.readouterr().err

    (folder / "etc/rig.yaml").touch()
    chosen()
    (folder / "config/simulated.yaml").touch()
    said = chosen()
    monkeypatch.setenv("THERMOCTL_CONFIG", "gone.yaml")  # named but missing: an error, never another rig
    chosen()
    assert chosen("--config", "own.yaml") == ""
    assert found == [str(folder / "etc/rig.yaml"), "config/simulated.yaml", "gone.yaml", "own.yaml"]
    assert said.count("\n") == (command in which_rig.ACTING)
    assert ("config/simulated.yaml" in said) == (command in which_rig.ACTING)


def test_a_missing_file_named_in_the_environment_is_an_error(folder, monkeypatch, capsys):
    """Before, the next file in the order was taken without a word: another rig."""
    (folder / "config").mkdir()
    (folder / "config/simulated.yaml").write_text("rig: {name: other}\n")
    monkeypatch.setenv("THERMOCTL_CONFIG", "gone.yaml")
    assert cli.main(["stop"]) == 2
    assert "gone.yaml" in capsys.readouterr().err


def test_commands_that_need_no_rig_ask_for_none(folder):
    for line in (
        ["diagnose", "r.csv", "--plant", "p", "--out", "o"],
        ["diagnose", "r.csv", "--plant", "p", "--out", "o", "--resolve", "--rig", "q.yaml"],
        ["experiment", "next.yaml", "--plant", "p"],
        ["experiment", "next.yaml", "--dry-run"],
        ["service", "uninstall"],
    ):
        which_rig.choose(command_line.parser().parse_args(line))


def test_init_copies_what_a_start_needs_and_keeps_what_is_there(folder, capsys):
    assert cli.main(["init"]) == 0
    assert {str(p) for p in folder.iterdir()} == {str(folder / name) for name in COPIED.values()}
    assert cli.main(["check", "config/simulated.yaml"]) == 0
    assert cli.main(["plant", "check", "examples/heater/plant.yaml"]) == 0
    (folder / "config/simulated.yaml").write_text("mine")
    assert cli.main(["init"]) == 2
    assert "exists already and is kept" in capsys.readouterr().err
    assert (folder / "config/simulated.yaml").read_text() == "mine"
