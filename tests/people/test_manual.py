"""Manual page and completions: made from the commands, understood by groff and bash, installed and removed."""

import shutil
import subprocess

import pytest

from thermoctl import cli
from thermoctl.cli.manual import PLACES, install, manual_page, uninstall
from thermoctl.files.yamlfile import InputError


def test_every_command_and_option_is_in_the_page():
    page = manual_page(cli.parser())
    for words in ("dashboard", "plant linearise", "recordings recover", "calibrate", "service"):
        assert f".SS {words}\n" in page
    assert (
        page.count("\n.SS ") >= 35
        and r"\fB\-\-simulated\-time\fR" in page
        and r"\fB\-\-hours\fR \fIH\fR" in page
    )
    assert ".B 130\n" in page


def test_groff_reads_the_page_without_a_warning():
    groff = shutil.which("groff")
    if groff is None:
        pytest.skip("no groff on this machine: the manual page is not formatted (apt-get install groff)")
    done = subprocess.run(
        [groff, "-man", "-ww", "-Tascii", "-P-cbou"],
        input=manual_page(cli.parser()),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and done.stderr == ""
    assert "EXIT STATUS" in done.stdout and "thermoctl" in done.stdout


def test_installed_completed_and_removed(tmp_path, capsys):
    assert cli.main(["manual", "install", "--root", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("wrote ") == len(PLACES)
    script = (
        f". {tmp_path / PLACES['bash']}; COMP_WORDS=(thermoctl rec); COMP_CWORD=1; "
        "_shtab_thermoctl thermoctl rec thermoctl; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
    assert done.stdout.split() == ["recordings"], done.stderr
    assert len(uninstall(tmp_path)) == len(PLACES) and uninstall(tmp_path) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--root"):
        install(cli.parser(), tmp_path / "file")
