"""The MATLAB export run by Octave, where that is installed."""

import re
import shutil
import subprocess

import numpy as np
import pytest
import scipy.io

from tests.export.plants import plants, recording
from thermoctl.export.commands import write
from thermoctl.plant.simulate import compile_plant

BLOCK = """\
classdef Block < handle
  properties
    NumInputPorts; NumOutputPorts; NumContStates; SampleTimes; SetPreCompPortInfoToDefaults = 0; CurrentTime = 0;
    InputPort; OutputPort; ContStates; Derivatives; Methods = struct();
  end
  methods
    function RegBlockMethod(block, name, f)
      block.Methods.(name) = f;
    end
  end
end
"""


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("octave-cli"), reason="octave-cli is not installed")
@pytest.mark.parametrize("name", ["hot-end", "extended", "friction", "static"])
def test_function_and_s_function(name, tmp_path):
    plant, dt = plants()[name]
    table = recording(plant, dt=dt)
    model = compile_plant(plant, ())
    excitation = model.prepare(model.excitation(table))
    run = model.run(excitation, rtol=1e-9)
    write(plant, "simulink-m", tmp_path / "exported.m", table)
    (tmp_path / "Block.m").write_text(BLOCK)
    scipy.io.savemat(tmp_path / "in.mat", {"t": excitation.t, "u": excitation.u[:, : len(plant.inputs)]})
    code = """load in.mat; [y, x] = exported(t, u, []);
    b = Block(); b.ContStates = struct('Data', []); b.Derivatives = struct('Data', []);
    b.InputPort = struct('Data', u(1, :)); b.OutputPort = struct('Data', []);
    exported(b); b.Methods.InitializeConditions(b); x0 = b.ContStates.Data;
    b.Methods.Outputs(b); y0 = b.OutputPort(1).Data; b.Methods.Derivatives(b); dx0 = b.Derivatives.Data;
    save -v6 out.mat y x x0 y0 dx0"""
    subprocess.run(["octave-cli", "--eval", re.sub(r"\\s+", " ", code)], cwd=tmp_path, check=True)
    found = scipy.io.loadmat(tmp_path / "out.mat")
    assert np.all(np.max(np.abs(found["y"] - run.y), axis=0) < 1e-6 * np.ptp(run.y, axis=0))
    assert np.allclose(found["y0"].ravel(), run.y[0])
    if plant.nodes:
        assert np.allclose(found["x0"].ravel(), run.x[0])
        dt = excitation.t[1] - excitation.t[0]
        assert np.allclose(
            found["dx0"].ravel(), (run.x[1] - run.x[0]) / dt, rtol=0.2, atol=0.05 * np.ptp(run.x) / dt
        )
