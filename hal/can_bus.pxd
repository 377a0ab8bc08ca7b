# C types for can_bus.py, which runs in every tick; see there.
cimport cython
from hal.devices cimport Device
from hal.wire cimport SlcanParser

cpdef double drive_state(int status_word)
cpdef int next_control_word(int status_word, bint enable)

cdef class SlcanPort:
    cdef public object _port
    cdef public int _fd
    cdef public SlcanParser _parser
    cdef public bytes _out

    cpdef list receive(self)

cdef class Cia402Device(Device):
    cdef public object _spec, _port, _transmit, _receive, _dictionary
    cdef public int _node, _status_word, _fault_code
    cdef public long long _command_limit
    cdef public list _index, _is_state
    cdef public double _patience_s, _heard_s, _beat_s, _reset_s
    cdef public tuple _ids

    @cython.locals(kind=cython.int, can_id=cython.long, i=cython.int, index=cython.int, state=cython.double)
    cpdef read(self, sample, double now_s)
    @cython.locals(word=cython.int, counts=cython.longlong)
    cpdef write(self, double drive, bint enable, double now_s)
