"""The proof of a calibration: the output's error without and with the new model."""

from types import SimpleNamespace

import numpy as np

from thermoctl.calibration import steps
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table


def test_a_proof_does_not_count_the_first_move_as_growth(tmp_path):
    """The output follows the reference by 3 um while it moves, also in the test's first rows."""

    t = np.arange(600) * 0.1
    reference = np.minimum(10.0 * t, 240.0)
    position = np.where(reference < 240.0, reference - 3.0, reference)
    columns = {
        "setpoint_um": np.full(600, 240.0),
        "reference_um": reference,
        "position_raw_um": position - 0.01 * t,  # compensated: 0.01 um/s of growth is taken back
        "output_reference_um": position + 7.0,  # another zero
    }
    write_table(tmp_path / "test_4b.parquet", Table("t", "t", t, columns))
    settings = SimpleNamespace(channels=None)
    proof = steps.proof(settings, {"test_4b": tmp_path / "test_4b.parquet"}, 0, acting=True)
    assert proof.better and abs(proof.after[0]) < 0.01 and proof.before[0] > 0.3
