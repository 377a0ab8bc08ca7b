# C types for devices.py, which runs in every tick; see there.
cimport cython
from thermoctl_hal.base.device cimport Device
from thermoctl_hal.base.wire cimport Ages

cdef class DevicesBackend:
    cdef public list fast, slow, _slow_drives, _copied, _copies
    cdef public object board, sample, required, _pacing
    cdef public object _stop
    cdef public dict roles, _owner, _seen, _repairs, _read_as
    cdef public list _threads
    cdef public Ages _ages
    cdef public double _now_s

    @cython.locals(device=Device, k=cython.int)
    cpdef read(self, double now_s)
    @cython.locals(device=Device)
    cpdef write(self, double drive, bint enable, int axis=*)
