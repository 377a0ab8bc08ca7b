# C types for cia402.py, whose states and steps are taken in every tick; see there.
cimport cython
from thermoctl_hal.base.wire cimport nearest

cdef double _OFFLINE, _DISABLED, _ENABLED, _FAULT, _QUICK_STOP, _RESET_S, _MAX_STEP_S

cpdef double drive_state(int status_word) noexcept
@cython.locals(state=cython.int)
cpdef int next_control_word(int status_word, bint enable) noexcept

cdef class Enabling:
    cdef public bint wanted, driving, left
    cdef public double left_to

    cpdef forget(self)
    cpdef bint wants(self, bint enable) noexcept
    cpdef double shown(self, double state) noexcept

cdef class DriveSteps(Enabling):
    cdef public int word, left_word
    cdef bint _tracks
    cdef long long _largest
    cdef double _low, _high, _scale, _slew, _position, _target, _target_s, _reset_s

    cpdef reconnect(self)
    @cython.locals(was_left=cython.bint, state=cython.double)
    cpdef double take(self, int word, double position) noexcept
    @cython.locals(word=cython.int)
    cpdef int control_word(self, bint enable, double now_s) noexcept
    @cython.locals(wanted=cython.double, is_enabled=cython.bint, step=cython.double)
    cpdef long long counts(self, double drive, double now_s) noexcept
