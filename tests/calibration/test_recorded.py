"""Recordings that no calibration can be made from: one line, and the calibration in use stays."""

import numpy as np
import pytest

from thermoctl.calibration import chain, recorded
from thermoctl.files.yamlfile import InputError
from thermoctl.recording.files import write_table
from thermoctl.recording.table import Table


def test(folder, **changed):
    """Write a recording of a rig with one point, of which columns are changed; return its path."""
    t = np.arange(300.0)
    columns = {n: np.ones(300) for n in (*recorded.EVERY_RIG, "coil_c")} | {"power_w": t % 50} | changed
    write_table(folder / "test.parquet", Table("test", "test", t, columns))
    return folder / "test.parquet"


test.__test__ = False


@pytest.mark.parametrize("name", ["power_w", "air_c", "coil_c", "position_raw_um", "output_reference_um"])
@pytest.mark.parametrize("value, found", [(np.nan, "no reading"), (1e300, "1e.300"), (-2e9, "2e.09")])
def test_a_column_without_a_possible_reading_is_named(tmp_path, name, value, found):
    """Before, it ended with a traceback, or made a calibration with an infinite error the current one."""
    spoiled = np.ones(300)
    spoiled[slice(None) if np.isnan(value) else 7] = value
    path = test(tmp_path, **{name: spoiled})
    if name == "output_reference_um" and np.isnan(value):
        return  # it may be measured in some tests only
    with pytest.raises(InputError, match=f"test.parquet: column '{name}': {found}; readings below"):
        recorded.read(path, ["coil"])


def test_tests_without_heat_are_refused(tmp_path):
    cold = recorded.read(test(tmp_path, power_w=np.zeros(300)), ["coil"])
    with pytest.raises(InputError, match="power_w is constant in all recordings"):
        chain.calibrate([cold, cold, cold])
