"""The command socket's path: only a socket of an earlier daemon is replaced."""

import socket

import pytest

from tests.simulated import rig_file
from thermoctl.cli import main
from thermoctl.daemon.command_server import listen
from thermoctl.files.yamlfile import InputError


def test_a_file_at_the_socket_path_is_kept(tmp_path):
    """A configuration or a recording that socket.path names by mistake."""
    path = tmp_path / "rig.yaml"
    path.write_text("rig: {name: mine}\n")
    with pytest.raises(InputError, match=r"rig\.yaml: a file that is no socket is there, and is kept"):
        listen(path, None)
    assert path.read_text() == "rig: {name: mine}\n"
    with pytest.raises(InputError, match="cannot listen: .*; check socket.path"):
        listen(path / "rig.sock", None)


def test_a_socket_that_a_killed_daemon_left_is_replaced(tmp_path):
    path = tmp_path / "rig.sock"
    socket.socket(socket.AF_UNIX).bind(str(path))
    listener = listen(path, None)
    socket.socket(socket.AF_UNIX).connect(str(path))
    listener.close()


def test_a_daemon_does_not_start_where_a_file_is_at_its_socket(tmp_path, capsys):
    """Before, its loop ran without a command socket, and `start` waited 90 s."""
    config = rig_file(tmp_path)
    (tmp_path / "simulated.sock").write_text("mine")
    assert main(["start", "--config", str(config)]) == 3
    assert "simulated.sock: a file that is no socket is there, and is kept" in capsys.readouterr().err
    assert (tmp_path / "simulated.sock").read_text() == "mine"
