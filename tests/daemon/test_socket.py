"""The command socket's path: only a socket of an earlier daemon is replaced."""

import socket

import pytest

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
