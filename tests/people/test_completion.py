"""Completions: made from the commands, understood by bash, installed and removed."""

import subprocess

import pytest

from thermoctl.cli import command_line
from thermoctl.cli.completion import PLACES, install, uninstall
from thermoctl.files.yamlfile import InputError


def test_installed_completed_and_removed(tmp_path):
    assert install(command_line.parser(), tmp_path) == [tmp_path / place for place in PLACES.values()]
    script = (
        f". {tmp_path / PLACES['bash']}; COMP_WORDS=(thermoctl rec); COMP_CWORD=1; "
        "_shtab_thermoctl thermoctl rec thermoctl; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["recordings"], done.stderr
    assert len(uninstall(tmp_path)) == len(PLACES) and uninstall(tmp_path) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--root"):
        install(command_line.parser(), tmp_path / "file")
