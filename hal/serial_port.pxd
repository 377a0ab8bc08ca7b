# C types for serial_port.py, which runs in every tick; see there.
cimport cython
from hal.devices cimport Device
from hal.wire cimport Framer

cdef class SerialDevice(Device):
    cdef public object _port, _lines, _invalid
    cdef public int _fd
    cdef public bint _waited
    cdef public Framer _framer
    cdef public double _due_s
    cdef public list _index

    @cython.locals(framer=Framer)
    cpdef bint wait_frame(self, long long until_ns) except -1
    @cython.locals(framer=Framer, i=cython.int, index=cython.int, field=cython.int, mask=cython.ulonglong)
    cpdef read(self, sample, double now_s)
