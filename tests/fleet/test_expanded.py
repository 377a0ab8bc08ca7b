"""Patterns and folders of recordings on the command line."""

from __future__ import annotations

import pytest

from thermoctl.files.yamlfile import InputError
from thermoctl.fleet.recordings import expanded


def test_patterns_and_folders_become_files(tmp_path):
    for name in ("b.csv", "a.csv", "plant.yaml"):
        (tmp_path / name).write_text("t,x\n0,1\n")
    both = [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]
    assert expanded([f"{tmp_path}/*.csv"], False) == both
    assert expanded([str(tmp_path)], True) == both
    assert expanded([str(tmp_path)], False) == [str(tmp_path)]  # a folder of rigs
    with pytest.raises(InputError, match="no file matches"):
        expanded([f"{tmp_path}/*.parquet"], False)
