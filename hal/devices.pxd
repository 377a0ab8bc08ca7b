# C types for devices.py, which runs in every tick; see there.
cimport cython
from hal.wire cimport Ages, Channels

cdef class Device:
    cdef public object binding, name, counts
    cdef public dict problems
    cdef public list roles
    cdef public bint slow, drives, up
    cdef public Channels _channels

    cpdef read(self, sample, double now_s)
    cpdef write(self, double drive, bint enable, double now_s)
    cpdef put(self, sample, int bound, double raw, double time_s)

cdef class DevicesBackend:
    cdef public list fast, slow
    cdef public object board, sample, required, _pacing
    cdef public object _stop
    cdef public dict _owner, _seen, _repairs
    cdef public list _threads
    cdef public Ages _ages
    cdef public double _now_s

    @cython.locals(device=Device)
    cpdef read(self, double now_s)
    @cython.locals(device=Device)
    cpdef write(self, double drive, bint enable)
