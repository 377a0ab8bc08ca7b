# C types for port.py, which runs in every tick; see there.
cimport cython
from thermoctl_hal.base.device cimport Device
from thermoctl_hal.base.wire cimport Framer

cdef class SerialDevice(Device):
    cdef public object _port, _line, _lines, _text, _fields, _sent
    cdef public str _why
    cdef public bytes _request
    cdef public int _fd, _flags, _unread
    cdef public unsigned long long _flag_mask, _flag_good
    cdef public double _request_hz, answer_s
    cdef public bint _waited, _echoes
    cdef public Framer _framer
    cdef public double _due_s
    cdef public int[::1] _index

    @cython.locals(framer=Framer)
    cpdef bint wait_frame(self, long long until_ns) except -1
    @cython.locals(framer=Framer)
    cpdef read(self, sample, double now_s)
    @cython.locals(i=cython.int, flags=cython.ulonglong)
    cdef _take_frame(self, sample, Framer framer, double now_s)
