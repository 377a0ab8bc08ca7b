"""A configuration of its own for each test: the simulated rig with a model, its files in the test's directory."""

import dataclasses

import numpy as np
import pytest

from tests.daemon.process import patient
from tests.simulated import rig_file
from thermoctl.configuration.settings import load_settings
from thermoctl.control.model import CompensatorModel


@pytest.fixture
def config(tmp_path):
    """Path of a configuration like config/simulated.yaml, socket and recordings in tmp_path, no real-time priority."""
    return patient(rig_file(tmp_path))


@pytest.fixture
def settings(config):
    return load_settings(config)


@pytest.fixture
def quiet(settings):
    """The settings without a model file, for tests that bring their own."""
    return dataclasses.replace(settings, compensation=dataclasses.replace(settings.compensation, model=""))


def make_model(kind="kalman"):
    """A coil and a bobbin that warm up, and an expansion of 1 um/K of each."""
    M = np.array([[-1.4 / 38.5, 1.3 / 38.5], [1.3 / 26.0, -1.6 / 26.0]])
    C = np.zeros((12, 2))
    C[0, 0] = C[1, 1] = 1.0
    B = np.array([[1 / 38.5, -1.0], [0.0, -1.0]])
    b2 = np.zeros(12)
    b2[:2] = 1.0
    gain = np.array([1e-2, 5e-3]) if kind == "kalman" else np.array([1.0, 0.7])
    return CompensatorModel(kind, 1e-3, M * 1e-3, B * 1e-3, C, gain, 1e-4, 0.01, 0.0, np.zeros(12), b2, 0.1)
