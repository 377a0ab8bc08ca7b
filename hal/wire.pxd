# The classes of wire.pyx as other compiled modules call them, without Python in between.
from libc.stdint cimport int64_t, uint8_t, uint16_t, uint32_t, uint64_t

cdef enum:
    MAX_READ = 4096             # bytes a tick takes from a port
    MAX_FRAME = 1024
    MAX_FIELDS = 64
    MAX_MESSAGE = 64            # the longest Lawicel message has 30 bytes

cdef class Framer:
    cdef readonly object spec
    cdef readonly long frames, bad, skipped, lost
    cdef readonly int size
    cdef object _payload
    cdef uint8_t[MAX_READ + MAX_FRAME] _buffer
    cdef uint8_t[MAX_FRAME] _newest
    cdef uint8_t[8] _sync
    cdef int _length, _sync_size, _head, _payload_size, _has_length, _crc_kind, _crc_big, _big, _sequence, _known
    cdef int[MAX_FIELDS] _offset
    cdef char[MAX_FIELDS] _type
    cdef uint64_t _modulus_mask

    cpdef int read(self, int fd) except -1
    cdef int _scan(self) noexcept
    cdef uint64_t _bits(self, int field, int size) noexcept
    cpdef uint64_t whole(self, int field) noexcept
    cpdef double number(self, int field) noexcept

cpdef bint wait_readable(int fd, int64_t until_ns) except -1

cpdef bytes encode_slcan(uint32_t can_id, bytes data)
cpdef bytes join_slcan(bytes before, tuple frames)
cpdef Py_ssize_t write_bytes(int fd, bytes data) except -1

cdef class SlcanParser:
    cdef public long bad, refused
    cdef uint8_t[MAX_MESSAGE] _rest
    cdef int _length

    cpdef list feed(self, const uint8_t[::1] data)
    cpdef list read(self, int fd)
    cdef int _feed(self, const uint8_t *data, int size, list frames) except -1
    cdef int _take(self, list frames) except -1

cdef class Channels:
    cdef readonly int[::1] roles
    cdef double[::1] scale, offset, low, high, value, time_s
    cdef uint8_t[::1] fresh, status
    cdef object _sample

    cpdef bint put(self, object sample, int channel, double raw, double time_s) except -1

cdef class Ages:
    cdef double[::1] time_s, limit_s
    cdef uint8_t[::1] fresh, status

    cpdef void begin(self) noexcept
    cpdef void judge(self, double now_s) noexcept
