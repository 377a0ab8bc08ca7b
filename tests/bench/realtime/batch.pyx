# cython: language_level=3, boundscheck=False, wraparound=False
"""What the bench needs in C: the product's law over prepared readings, and the probe at the end of a tick."""
from libc.stdint cimport int64_t
from libc.string cimport memcpy

from thermoctl.control.law cimport Law
from thermoctl.daemon.tick.clock cimport now_ns


cdef class Probe:
    """The loop's question `stopping()`, which notes the time in `stamps` before it is asked."""
    cdef int64_t[::1] stamps
    cdef object stopping
    cdef Py_ssize_t at

    def __init__(self, int64_t[::1] stamps, stopping):
        self.stamps, self.stopping = stamps, stopping

    def __call__(self):
        if self.at < self.stamps.shape[0]:
            self.stamps[self.at] = now_ns()
            self.at += 1
        return self.stopping()


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
