# cython: language_level=3, boundscheck=False, wraparound=False
"""The product's compiled law over prepared readings, tick after tick: what its arithmetic costs, without Python in between."""
from libc.string cimport memcpy
from thermoctl.control.law cimport Law


def run(Law law, double[:, ::1] values, unsigned char[:, ::1] fresh, unsigned char[:, ::1] status, double[::1] dt,
        int[::1] commands, double[::1] command_values, double[:, ::1] outputs, double[::1] value, unsigned char[::1] now,
        unsigned char[::1] state):
    """Every row into the bound arrays `value`, `now`, `state`, one step, its outputs out: as batch_run of law.c."""
    cdef Py_ssize_t k, n = values.shape[1], m = outputs.shape[1]
    for k in range(values.shape[0]):
        memcpy(&value[0], &values[k, 0], n * sizeof(double))
        memcpy(&now[0], &fresh[k, 0], n)
        memcpy(&state[0], &status[k, 0], n)
        law.step(dt[k], commands[k], command_values[k], 0)
        memcpy(&outputs[k, 0], &law.out[0], m * sizeof(double))
