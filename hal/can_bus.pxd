# C types for can_bus.py, which runs in every tick; see there.
from thermoctl_hal.wire cimport SlcanLine

cdef class SlcanPort(SlcanLine):
    cdef public object _port
