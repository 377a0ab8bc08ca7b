# C types for bus.py, which runs in every tick; see there.
from thermoctl_hal.base.wire cimport SlcanLine

cdef class SlcanPort(SlcanLine):
    cdef public object _port
