# C types for cia402.py, whose states are read in every tick; see there.
cimport cython

cdef double _OFFLINE, _DISABLED, _ENABLED, _FAULT, _QUICK_STOP

cpdef double drive_state(int status_word) noexcept
@cython.locals(state=cython.int)
cpdef int next_control_word(int status_word, bint enable) noexcept
