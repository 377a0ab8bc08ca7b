# C types for drive.py, which runs in every tick; see there.
cimport cython
from thermoctl_hal.base.cia402 cimport drive_state, next_control_word
from thermoctl_hal.base.device cimport Device
from thermoctl_hal.base.wire cimport CanPort, nearest

cdef int _SYNC_ID, _PRE_OPERATIONAL
cdef double _OFFLINE, _ENABLED, _FAULT, _RESET_S

cdef class Cia402Device(Device):
    cdef public object _spec, _formats
    cdef public CanPort _port
    cdef public int _odd_size, _node, _master, _status_word, _fault_code, _transmit_size, _receive_size
    cdef public long long _command_limit, _frames, _emergencies, _odd
    cdef public int[::1] _index, _is_state, _shift, _bits, _signed
    cdef public double _patience_s, _heartbeat_s, _heard_s, _beat_s, _reset_s, _low, _high, _scale
    cdef public tuple _ids
    cdef public int _actual
    cdef public double _slew, _target, _target_s, _actual_counts
    cdef public bint _wanted, _driving, _left
    cdef public double _left_to
    cdef public int _left_word

    @cython.locals(port=CanPort, kind=cython.long, k=cython.int, size=cython.int, data=cython.ulonglong)
    cpdef read(self, sample, double now_s)
    cdef _take_heartbeat(self, CanPort port, unsigned long long state, double now_s)
    @cython.locals(i=cython.int, state=cython.double)
    cdef _store(self, sample, unsigned long long data, double now_s)
    cpdef double _watch_state(self, double state) noexcept
    @cython.locals(raw=cython.longlong, span=cython.longlong)
    cdef double _number(self, unsigned long long data, int k) noexcept
    @cython.locals(step=cython.double, wanted=cython.double)
    cdef long long _position_target(self, double drive, bint steps, double now_s) except? -1
    @cython.locals(port=CanPort, word=cython.int, counts=cython.longlong, steps=cython.bint)
    cpdef write(self, double drive, bint enable, double now_s)
