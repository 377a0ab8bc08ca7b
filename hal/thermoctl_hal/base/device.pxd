# C types for device.py, which runs in every tick; see there.
from thermoctl_hal.base.wire cimport Channels

cdef class Device:
    cdef public object binding, name, counts, is_urgent
    cdef public dict problems
    cdef public list roles
    cdef public bint slow, drives, up
    cdef public int axis
    cdef public Channels _channels

    cpdef read(self, sample, double now_s)
    cpdef write(self, double drive, bint enable, double now_s)
    cpdef put(self, sample, int bound, double raw, double time_s)
